"""What rasterizers/torch_internals.py relies on, entry by entry: a torch that has changed one fails here, under its name."""

import ast
import threading
from pathlib import Path

import pytest
import torch
from torch.nn import Parameter

from rasterizers import torch_internals as of_torch
from tests.helpers.paths import ROOT

HIDDEN = {  # attributes of torch's objects
    "_version", "_base", "_backward_hooks", "_post_accumulate_grad_hooks", "_schema", "_input_metadata",
}  # fmt: skip


def in_a_pass(call, x=None, *, by=torch.Tensor.backward):
    """What `call` returns inside of a backward pass over x."""
    x, found = Parameter(torch.ones(3)) if x is None else x, []
    y = 2 * x
    y.register_hook(lambda _: found.append(call()))
    by(y.sum())
    return found


def test_each_backward_pass_of_a_thread_has_a_number_of_its_own_and_none_runs_outside_of_it():
    numbers = [*in_a_pass(of_torch.current_pass), *in_a_pass(of_torch.current_pass)]
    assert numbers[0] != numbers[1]
    assert min(numbers) >= 0 > of_torch.current_pass()


def test_a_pass_calls_once_at_its_end_before_backward_returns():
    x, seen = Parameter(torch.ones(3)), []
    in_a_pass(lambda: of_torch.when_pass_ends(lambda: seen.append(x.grad.tolist())), x)
    assert seen == [[2.0] * 3]


def test_a_pass_calls_what_this_package_asks_for_after_what_others_ask_for():
    seen = []

    def ask():
        of_torch.when_pass_ends(lambda: seen.append("this package"))
        torch.autograd.Variable._execution_engine.queue_callback(lambda: seen.append("others"))

    in_a_pass(ask)
    assert seen == ["others", "this package"]


@pytest.mark.parametrize(
    ("register", "hooks"),
    [
        (torch.Tensor.register_hook, of_torch.hooks_on_gradient),
        (torch.Tensor.register_post_accumulate_grad_hook, of_torch.hooks_after_accumulation),
    ],
)
def test_a_pass_calls_the_hooks_that_it_finds_in_their_mapping(register, hooks):
    x, seen = Parameter(torch.ones(3)), []
    assert (of_torch.is_hooked(x), len(hooks(x))) == (False, 0)
    handle = register(x, lambda _: seen.append("the hook"))
    assert of_torch.is_hooked(x)
    hooks(x)[handle.id] = lambda _: seen.append("another")
    (2 * x).sum().backward()
    hooks(x).clear()
    (2 * x).sum().backward()
    assert seen == ["another"]


def test_the_node_of_a_views_base_stays_in_the_graph_where_the_view_is_written_in_place():
    seen, base = [], 2 * Parameter(torch.ones(3))
    view = base[:2]
    for x in (view, of_torch.base_of(view)):
        x.grad_fn.register_prehook(lambda _, shape=x.shape: seen.append(shape))
    view.mul_(2)
    view.sum().backward()
    assert seen == [base.shape]
    assert of_torch.base_of(base) is base


def test_a_view_that_a_node_of_ones_own_returns_has_no_base_in_the_graph():
    class Part(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return torch.cat((x, x))[: len(x)]

        @staticmethod
        def backward(ctx, g):
            return g

    part = Part.apply(Parameter(torch.ones(3)))
    assert part._base is not None
    assert of_torch.base_of(part) is part


def test_a_pass_that_fails_calls_nothing():
    called = []

    def fails():
        of_torch.when_pass_ends(lambda: called.append(1))
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        in_a_pass(fails)
    in_a_pass(lambda: None)
    assert not called


@pytest.mark.parametrize(
    ("by", "expected"),
    [(lambda y, _: y.backward(), True), (lambda y, x: y.backward(inputs=[x]), True), (torch.autograd.grad, False)],
)
def test_a_pass_adds_to_a_leaf_or_returns_its_gradient(by, expected):
    x = Parameter(torch.ones(3))
    assert in_a_pass(lambda: of_torch.accumulates(x), x, by=lambda y: by(y, x)) == [expected]
    assert of_torch.accumulator(x) is of_torch.accumulator(x)
    assert of_torch.leaf_of(of_torch.accumulator(x)) is x


def test_a_node_is_that_of_a_leaf_or_of_cat_or_another():
    x = Parameter(torch.ones(3))
    joined, added = torch.cat((x, x)).grad_fn, (x + x).grad_fn
    assert [of_torch.is_cat(node) for node in (joined, added)] == [True, False]
    assert (of_torch.leaf_of(joined), of_torch.leaf_of(added)) == (None, None)


@pytest.mark.parametrize("leaf", [False, True])
def test_the_gradient_of_an_edge_has_the_shape_and_type_of_its_tensor(leaf):
    x = Parameter(torch.ones(2, 3, dtype=torch.float64))
    edge = torch.autograd.graph.get_gradient_edge(x if leaf else x[:1])
    assert of_torch.of_gradient(edge) == (torch.Size((2 if leaf else 1, 3)), torch.float64)


def test_a_write_by_a_view_is_another_version():
    x = torch.zeros(3)
    before = of_torch.version(x)
    x[:1].add_(1)
    assert of_torch.version(x) > before
    assert of_torch.version(x.data) != of_torch.version(x)


def test_a_transform_is_seen_inside_of_it():
    seen = []
    torch.func.grad(lambda x: seen.append(of_torch.is_transformed()) or x.sum())(torch.ones(3))
    assert (seen, of_torch.is_transformed()) == ([True], False)


def test_pairs_are_copied():
    to, of = [torch.zeros(2), torch.zeros(3)], [torch.ones(2), torch.ones(3)]
    of_torch.copy_each([*zip(to, of, strict=True)])
    assert all(map(torch.equal, to, of))


def test_operations_are_seen_below_autograd_with_what_they_do_in_their_own_thread():
    class Seen(of_torch.TorchDispatchMode):
        def __torch_dispatch__(self, op, types, args=(), kwargs=None):
            seen.append((op.overloadpacket.__name__, of_torch.writes(op), of_torch.reads_number(op), op.is_view))
            return op(*args, **kwargs or {})

    seen, x = [], torch.ones(3, requires_grad=True)
    with Seen():
        (other := threading.Thread(target=lambda: torch.ones(3))).start()
        other.join()
        float(x.detach().mul_(2)[0])
    assert seen == [
        ("detach", False, False, True),
        ("mul_", True, False, False),
        ("select", False, False, True),
        ("_local_scalar_dense", False, True, False),
    ]


def test_the_leaves_of_nested_arguments():
    assert of_torch.tree_leaves(((1, [2]), {"a": (3, {"b": 4})})) == [1, 2, 3, 4]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="only builds for CUDA have it")
def test_builds_for_cuda_have_what_ends_a_pool():
    assert hasattr(torch._C, "_cuda_endAllocateToPool") == (torch.__version__ >= "2.8")


def private(path: Path) -> set[str]:
    """The names without a promise that a file uses of torch."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "torch":
            names = [*node.module.split("."), *(alias.name for alias in node.names)]
        elif isinstance(node, ast.Attribute):
            dotted = ast.unparse(node).split(".")
            names = dotted if dotted[0] == "torch" else HIDDEN & {node.attr}
        elif isinstance(node, ast.Constant):
            names = HIDDEN & {node.value} if isinstance(node.value, str) else ()
        else:
            continue
        found |= {name for name in names if name.startswith("_") and not name.startswith("__")}
    return found


def test_no_other_file_uses_a_private_name_of_torch():
    files = [
        path
        for package in ("clear_strategies", "integration", "rasterizers")
        for path in (ROOT / package).rglob("*.py")
    ]
    found = {path.relative_to(ROOT).as_posix(): names for path in files if (names := private(path))}
    assert found.pop("rasterizers/torch_internals.py") >= {"_C", "_execution_engine", *HIDDEN}
    assert found == {"clear_strategies/bench/results.py": {"_sleep"}}  # a benchmark, which only a GPU runs
