"""The autograd graph of a host: what tensors were computed from, where a rasterizer draws them, and in which order of rows."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import accumulate
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor
from torch.autograd.graph import GradientEdge, get_gradient_edge

from clear_strategies.errors import HostError
from integration.structure import rows_drawn
from rasterizers.differentiable import Drawing
from rasterizers.torch_internals import hooks_on_gradient, is_cat, leaf_of, of_gradient

_GOLDEN: Final = 0.6180339887498949  # its multiples modulo 1 differ most for neighbouring rows
_MOST: Final = 16  # calls of a rasterizer, and operations from the centres to it; one that loops in torch has thousands
_SAME_CODE: Final = 0.1  # tolerance of the ratio of a row's gradients, which e.g. the mean of all rows changes a little

Edge = Tensor | GradientEdge
"""A tensor in the graph, or where its gradient arrives."""


class Graph(NamedTuple):
    """What tensors were computed from.

    Args:
        nodes: of autograd.
        drawn: what this package's rasterizers drew for them, by its node.
    """

    nodes: set[Any]
    leaves: list[Tensor]
    drawn: dict[Any, Drawing]

    def reaches(self, leaves: Iterable[Tensor]) -> bool:
        """Whether one of these is among its leaves."""
        return not {*map(id, leaves)}.isdisjoint(map(id, self.leaves))


def graph_of(*edges: Edge, before: Iterable[Any] = ()) -> Graph:
    """The graph behind tensors, in one walk around the nodes `before`. A leaf is its own."""
    graph = Graph(set(), [], {})
    for node in _behind(edges, before):
        graph.nodes.add(node)
        if (leaf := leaf_of(node)) is not None:
            graph.leaves.append(leaf)
        elif isinstance(drawing := getattr(node, "drawing", None), Drawing):
            graph.drawn[node] = drawing
    return graph


def _behind(edges: Iterable[Edge], before: Iterable[Any]) -> Iterator[Any]:
    seen: set[Any] = {*before}
    nodes: list[Any] = [edge_of(x).node for x in edges if has_gradient(x)]
    while nodes:
        if (node := nodes.pop()) is None or node in seen:
            continue
        seen.add(node)
        yield node
        nodes += [behind for behind, _ in node.next_functions]


def joined(x: Tensor) -> list[tuple[Edge, slice]]:
    """What `torch.cat` joined to this tensor along its second dimension, and where each lies there; else itself."""
    nodes = x.grad_fn.next_functions if x.grad_fn is not None and is_cat(x.grad_fn) else ()
    edges = [GradientEdge(node, nr) for node, nr in nodes if node is not None]
    ends = [*accumulate(of_gradient(edge)[0][1] for edge in edges)]
    if not edges or len(edges) < len(nodes) or ends[-1] != x.shape[1]:
        return [(x, slice(0, x.shape[1]))]
    return [*zip(edges, map(slice, [0, *ends], ends), strict=True)]


class Inputs(NamedTuple):
    """The inputs of the rasterizer that drew an image in a host's graph, found without its help.

    A rasterizer is a node of autograd that passes the screen gradient on to the tensor of projected centres, and stands between
    the image and all parameters. Its gradients are those of its inputs alone, without what these get through one another, as
    positions do through colours that are computed from directions.

    Args:
        nodes: of the rasterizer, one for each of its calls.
        edges: where the gradients of its inputs with a row for each Gaussian go, by name.
        shared: leaves behind these that reach the image beside the rasterizer, too, of whose gradients the edges bring a part.
        by_camera: names of those whose gradients are [1, N, …].
    """

    nodes: Collection[Any]
    edges: Mapping[str, GradientEdge]
    shared: Sequence[Tensor] = ()
    by_camera: Collection[str] = ()

    @contextmanager
    def collected(self) -> Iterator[dict[str, Tensor]]:
        """The gradients of the edges by name, [N, …], of the one backward pass in this context."""
        found: dict[str, Tensor] = {}

        def keep(i: int, of_inputs: Sequence[Tensor | None]) -> None:
            of_node = {_name(i, j): g for j, g in enumerate(of_inputs)}
            of_edges = {name: g for name, g in of_node.items() if g is not None and name in self.edges}
            found.update({name: g[0] if name in self.by_camera else g for name, g in of_edges.items()})

        with ExitStack() as hooks:
            for i, node in enumerate(self.nodes):
                hooks.callback(node.register_hook(lambda of_inputs, _, i=i: keep(i, of_inputs)).remove)
            yield found


def centres_drawn(graph: Graph) -> Iterator[tuple[Edge, Tensor]]:
    """Where the screen gradients go of what this package's rasterizers drew, and the centres."""
    for node, drawing in graph.drawn.items():
        inputs = sum(x is not None for x in drawing.inputs)  # the last arguments of the node, after the centres
        yield GradientEdge(*node.next_functions[-1 - inputs]), drawing.rendering.means2d


def copied_to(edge: Edge, centres: Tensor, means: Tensor) -> list[Tensor]:
    """The leaf whose copy a tensor is, as hosts make one for the screen gradient (`torch.zeros(n, 3, requires_grad=True) + 0`);
    itself if it is a leaf. No optimizer steps it, unlike other leaves from which centres are computed, with those of `means`.

    Args:
        edge: of the tensor. centres: its values.
    """
    leaves = graph_of(edge).leaves
    if means.requires_grad:  # without a wait for the device
        return leaves if len(leaves) == 1 else []
    alike = (x for x in leaves if x.numel() == centres.numel())  # gsplat's have a dimension of cameras
    return [x for x in alike if torch.equal(x.reshape(centres.shape).to(centres), centres)]


def inputs_of(
    image: Tensor, graph: Graph, centres: Tensor, params: Mapping[str, Tensor], others: Iterable[Tensor]
) -> Inputs | None:  # fmt: skip
    """The inputs of the rasterizer that drew `image`; None: it is no single node and none of this package's, or its rows are not
    those of the parameters.

    Args:
        graph: of the image.
        centres: through which another package's passes the screen gradient.
        params: raw parameters by gsplat's names, with N rows. others: leaves that are trained beside them.
    """
    n = len(params["means"])
    own = [p for name, p in params.items() if name != "detail"]
    readers = dict[Any, set[Any]]()
    for x in graph.nodes:
        for behind, _ in x.next_functions:
            readers.setdefault(behind, set()).add(x)
    nodes = {*graph.drawn}
    if not nodes and centres.requires_grad:
        probe = edge_of(centres)
        nodes = {x for x in readers.get(probe.node, ()) if (probe.node, probe.output_nr) in x.next_functions}
    steps = 0
    while nodes and graph_of(image, before=nodes).reaches(own):  # on to what is computed from these
        nodes, steps = {reader for x in nodes for reader in readers.get(x, ())}, steps + 1
        if max(steps, len(nodes)) > _MOST:
            return None
    if not nodes:
        return None
    inputs = {
        _name(i, j): GradientEdge(behind, nr)
        for i, node in enumerate(nodes)
        for j, (behind, nr) in enumerate(node.next_functions)
        if behind is not None
    }
    graphs = {name: graph_of(edge) for name, edge in inputs.items()}
    of_own = {name for name, found in graphs.items() if found.reaches(own)}
    shapes = {name: of_gradient(edge)[0] for name, edge in inputs.items()}
    by_camera = {name for name, shape in shapes.items() if shape[:2] == (1, n) and n > 1}
    has_rows = by_camera | {name for name, shape in shapes.items() if shape[:1] == (n,)}
    if of_own - has_rows or any(not found.nodes.isdisjoint(nodes) for found in graphs.values()):
        return None
    edges = {name: inputs[name] for name in has_rows if name in of_own or graphs[name].reaches(others)}
    beside = {*map(id, graph_of(image, before=nodes).leaves)}
    shared = [leaf for leaf in graph_of(*edges.values()).leaves if id(leaf) in beside]
    near_first = sorted(of_own, key=lambda name: len(graphs[name].nodes))  # a network may lie between the others
    pairs = [(inputs[name], p) for name in near_first for p in own if graphs[name].reaches([p])]
    is_drawn = any(edge == edge_of(p) for edge, p in pairs)  # without waits of the test for the device
    return Inputs(nodes, edges, shared, by_camera) if is_drawn or (pairs and _are_in_order(pairs)) else None


def reaching(drawn: Mapping[str, Tensor]) -> tuple[str, str] | None:
    """One of the drawn tensors and another that is computed from it; that of f_det does not count. None: there is no such."""
    nodes = {name: edge_of(x).node for name, x in drawn.items() if x.requires_grad and name != "detail"}
    for name, node in nodes.items():
        behind = graph_of(drawn[name]).nodes - {node}
        for other, of_other in nodes.items():
            if of_other in behind:
                return other, name
    return None


def require_apart(drawn: Mapping[str, Tensor]) -> None:
    """Raise a HostError if one of the drawn tensors is computed from another, whose gradient would count twice."""
    if pair := reaching(drawn):
        raise HostError(
            f"AutogradShot: {pair[0]} of drawn reaches {pair[1]} of drawn, too, so that its gradient would count twice. "
            f"Draw an alias, x = {pair[0]}.view_as({pair[0]}), and name that."
        )


def require_in_order(what: str, drawn: Mapping[str, Tensor] | None, params: Mapping[str, Tensor]) -> None:
    """Raise a HostError unless row i of the drawn tensors is computed from row i of the parameters; None: the parameters are
    drawn.

    Args:
        what: is rendered.
    """
    if drawn is not None and not _are_drawn_in_order(drawn, params):
        raise HostError(
            f"{what} is rendered with its Gaussians in another order than that of the parameters, so that f_det and dropout "
            "would go to others. Render them as they are, since the rasterizer sorts by depth itself, or sort the parameters."
        )


def _are_drawn_in_order(drawn: Mapping[str, Tensor], params: Mapping[str, Tensor]) -> bool:
    """A tensor with the parameter's memory is. Any other is tested by two cotangents, whose rows i are 1 and c_i: in the same
    order, the gradients of the parameter's row i are g and c_i g, otherwise g and c_j g. If no tensor has a gradient, positions
    are compared.
    """
    asked = list[tuple[Tensor, Tensor]]()
    for name in ("opacities", "scales", "means", "quats", "colors"):
        x, p = drawn.get(name), params.get("sh0" if name == "colors" else name)
        if x is None or p is None or x.shape[:1] != p.shape[:1]:
            continue
        if x.data_ptr() == p.data_ptr() and x.stride() == p.stride():
            return True
        if x.requires_grad and p.requires_grad:
            asked.append((x, p))
    if asked or "means" not in drawn:
        return _are_in_order(asked)
    return rows_drawn(drawn["means"].detach(), params["means"].detach()) is None


def _are_in_order(pairs: Iterable[tuple[Edge, Tensor]]) -> bool:
    """Whether row i of what is drawn is computed from row i of a parameter; also if nothing that is drawn depends on it."""
    answers = set[bool | None]()
    for x, p in pairs:
        if (answer := _is_in_order(x, p)) is True:
            return True
        answers.add(answer)
    return False not in answers


def _is_in_order(x: Edge, p: Tensor) -> bool | None:
    """None: x does not depend on p."""
    shape, dtype = of_gradient(edge := edge_of(x))
    columns = len(shape) - 1 - (shape[0] != len(p))  # behind the rows, of one camera
    code = 1 + (torch.arange(len(p), device=p.device, dtype=torch.float64) * _GOLDEN).frac().to(dtype)
    with without_hooks([p]):
        plain, coded = (
            torch.autograd.grad([edge], p, [c], retain_graph=True, allow_unused=True)[0]
            for c in (code.new_ones(shape), code.view(-1, *[1] * columns).expand(shape))
        )
    if plain is None or not bool(plain.any()):
        return None
    plain, coded = plain.reshape(len(p), -1), coded.reshape(len(p), -1)
    off = torch.addcmul(coded, code.to(plain)[:, None], plain, value=-1)
    return bool((off.abs_().sum(1) <= _SAME_CODE * plain.abs_().sum(1)).all())


@contextmanager
def without_hooks(leaves: Sequence[Tensor]) -> Iterator[None]:
    """A context in which gradients reach these leaves past their hooks, which are called with the merged gradient."""
    held = [(hooks, dict(hooks)) for hooks in map(hooks_on_gradient, leaves)]
    for hooks, _ in held:
        hooks.clear()
    try:
        yield
    finally:
        for hooks, each in held:
            hooks.update(each)


def _name(node: int, place: int) -> str:
    return f"input {place} of call {node}"


def has_gradient(x: Edge) -> bool:
    """Whether it is in a graph."""
    return isinstance(x, GradientEdge) or x.requires_grad


def edge_of(x: Edge) -> GradientEdge:
    """Where its gradient arrives."""
    return x if isinstance(x, GradientEdge) else get_gradient_edge(x)
