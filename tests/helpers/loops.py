"""Training loops put together of parts, and what a step of each should leave in `.grad`, by plain torch in float64.

A part is a small function of `p`, the tensors by name: gsplat's six parameters, and some that a loop trains beside them.
"""

import functools
import random
import warnings
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch.nn import Parameter

from clear_strategies import GCO, Conductor, Grads, Step
from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.training.field import GaussianField
from integration.gsplat import attach
from integration.gsplat.rows import ROWS
from rasterizers import autograd, differentiable
from tests.helpers import toy
from tests.helpers.host_parts import HR_FROM_START, photometric

COLOURS = {
    "joined": lambda p: torch.cat((p["sh0"], p["shN"]), 1),
    "with an offset": lambda p: torch.cat((p["sh0"] + p["offset"], p["shN"]), 1),
    "by the means": lambda p: torch.cat((p["sh0"] + p["means"][:, None], p["shN"]), 1),
    "an offset with them": lambda p: torch.cat((p["offset"] + p["sh0"], p["shN"]), 1),
    "once and a half": lambda p: torch.cat((p["sh0"] + 0.5 * p["sh0"], p["shN"]), 1),
    "times a gain": lambda p: torch.cat((p["sh0"], p["shN"]), 1) * p["gain"],
    "of three": lambda p: torch.cat((p["sh0"], p["shN"][:, :3], p["shN"][:, 3:]), 1),
    "viewed": lambda p: torch.cat((p["sh0"], p["shN"]), 1).view(len(p["sh0"]), -1, 3),
    "cast": lambda p: torch.cat((p["sh0"].double(), p["shN"].double()), 1).to(p["means"].dtype),
    "another leaf": lambda p: p["bands"] if len(p["bands"]) == len(p["sh0"]) else p["bands"][1:],
    "half detached": lambda p: torch.cat((p["sh0"], p["shN"].detach()), 1),
    "negative dimension": lambda p: torch.cat((p["sh0"], p["shN"]), -2),
}
OPACITIES = {
    "sigmoid": lambda p: p["opacities"].sigmoid(),
    "faded": lambda p: p["opacities"].sigmoid() * p["gain"],
    "detached": lambda p: p["opacities"].detach().sigmoid(),
    "by the colours": lambda p: (p["opacities"] + p["sh0"][:, 0, 0]).sigmoid(),
}
MEANS = {
    "leaf": lambda p: p["means"],
    "moved": lambda p: p["means"] + p["shift"],
    "times one": lambda p: p["means"] * 1,
}
HOOKS = {
    "none": lambda p, colors: None,
    "of a leaf": lambda p, colors: p["shN"].requires_grad and p["shN"].register_hook(lambda g: g * 0.5),
    "of another leaf": lambda p, colors: p["means"].requires_grad and p["means"].register_hook(lambda g: g * 0.5),
    "of the colours": lambda p, colors: colors.requires_grad and colors.register_hook(lambda g: g * 0.5),
    "that keeps them": lambda p, colors: colors.requires_grad and colors.retain_grad(),
    "after": lambda p, colors: p["sh0"].requires_grad and p["sh0"].register_post_accumulate_grad_hook(lambda q: None),
}


def in_place(renders, mask):
    renders[0, ~mask] = 0
    return renders[0]


MASKS = {
    "none": lambda renders, mask: renders[0],
    "times": lambda renders, mask: renders[0] * mask[..., None],
    "in place": in_place,
    "times in place": lambda renders, mask: renders.mul_(mask[..., None])[0],
    "a view in place": lambda renders, mask: renders[0].mul_(mask[..., None]),
}
BESIDE = {
    "none": lambda p, colors, alphas: 0,
    "opacities": lambda p, colors, alphas: 0.01 * p["opacities"].sigmoid().mean(),
    "scales": lambda p, colors, alphas: 0.01 * p["scales"].exp().mean(),
    "colours": lambda p, colors, alphas: 0.01 * colors.square().mean(),
    "f_det": lambda p, colors, alphas: 0.01 * p["detail"].mean(),
    "alphas": lambda p, colors, alphas: 0.01 * alphas.square().mean(),
}


def asked(loss, p):
    torch.autograd.grad(loss, [x for x in p.values() if x.requires_grad], retain_graph=True, allow_unused=True)


def backward(loss, p, *names, **settings):
    """The pass to the leaves of these names alone; none where they are frozen."""
    if leaves := [p[name] for name in names if p[name].requires_grad]:
        loss.backward(inputs=leaves, **settings)


def passes(*each):
    return lambda loss, p: [one(loss, p) for one in each]


PASSES = {
    "one": lambda loss, p: loss.backward(),
    "one with a graph": lambda loss, p: loss.backward(create_graph=True),
    "asked before": passes(asked, lambda loss, p: loss.backward()),
    "asked after": passes(lambda loss, p: loss.backward(retain_graph=True), asked),
    "to the colours": lambda loss, p: backward(loss, p, "sh0", "shN"),
    "to one colour": lambda loss, p: backward(loss, p, "sh0"),
    "to the geometry": lambda loss, p: backward(loss, p, "means", "scales", "quats"),
    "in two parts": passes(
        lambda loss, p: backward(loss, p, "sh0", "shN", retain_graph=True),
        lambda loss, p: backward(loss, p, "means", "quats", "scales", "opacities"),
    ),
    "two halves": passes(lambda loss, p: (loss / 2).backward(retain_graph=True), lambda loss, p: (loss / 2).backward()),
    "two halves of the colours": passes(*[lambda loss, p: backward(loss / 2, p, "sh0", "shN", retain_graph=True)] * 2),
    "none": asked,
}  # fmt: skip
REFUSED = {"two summed": "two renderings of training views", "an earlier one": "an earlier rendering"}
FROZEN = ((), (), ("means", "quats", "scales", "opacities"), ("sh0",), ("sh0", "shN"), ("quats", "shN"), ("opacities",))
ADAM = {"lr": 1e-3, "eps": 1e-15}


def unrecorded(*args, **call):
    """This package's rasterization as CLEAR sees gsplat's own: by no drawing that it knows."""
    collecting = differentiable._collecting.set(())
    try:
        return autograd.rasterization(*args, **call)
    finally:
        differentiable._collecting.reset(collecting)


def gsplats(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **call):
    """A function of gsplat's signature."""
    return unrecorded(means, quats, scales, opacities, colors, viewmats, Ks, width, height, backend="cpp", **call)


FUNCTIONS = {"ours": functools.partial(autograd.rasterization, backend="cpp"), "another": gsplats}


Pair = tuple[tuple[str, object], ...]


@dataclass(frozen=True)
class Loop:
    """Which parts a loop is made of; a string is a key of the table of its part."""

    function: str = "ours"
    corrects: bool = True
    colours: str = "joined"
    opacities: str = "sigmoid"
    means: str = "leaf"
    hook: str = "none"
    late_hook: str = "none"
    mask: str = "none"
    beside: str = "none"
    passes: str = "one"
    rendering: str = "one"
    optimizers: str = "each"
    frozen: tuple[str, ...] = ()
    frozen_from: int = 0
    accumulation: int = 1
    scale: float = 1.0
    zeros: bool = False
    densified: bool = False

    def refusal(self) -> str:
        """What its rendering and its passes are refused with, whatever the rest is."""
        if self.rendering in REFUSED:
            return REFUSED[self.rendering]
        return "a second backward pass" if self.passes.startswith("two halves") and self.corrects else ""

    def pairs(self) -> set[Pair]:
        """Any two of its parts; of a loop that is refused those alone that have to do with it, for it shows no gradient."""
        names = vars(self).items()
        if self.rendering in REFUSED:
            return {pair for pair in combinations(names, 2) if ("rendering", self.rendering) in pair}
        refused = bool(self.refusal())
        return {pair for pair in combinations(names, 2) if not refused or ("passes", self.passes) in pair}


CHOICES = {
    "function": FUNCTIONS, "corrects": (True, False), "colours": COLOURS, "opacities": OPACITIES, "means": MEANS, "hook": HOOKS,
    "late_hook": HOOKS, "mask": MASKS, "beside": BESIDE, "passes": PASSES, "rendering": ("one", "evaluated between", *REFUSED),
    "optimizers": ("each", "joined", "joined in a dictionary", "made anew"), "frozen": FROZEN, "frozen_from": (0, 1),
    "accumulation": (1, 2), "scale": (1.0, 128.0), "zeros": (False, True), "densified": (False, True),
}  # fmt: skip


def of_any_two_parts() -> list[Loop]:
    """Random loops in which all parts that can meet do so by two and two, about a sixth of each loop's parts the ordinary ones.
    Each is the one of forty in which most parts meet for the first time.
    """
    chance = random.Random(0)  # noqa: S311

    def drawn() -> Loop:
        return Loop(**{name: chance.choice([*values]) for name, values in CHOICES.items() if chance.random() < 0.85})

    loops, met, in_vain = list[Loop](), set[Pair](), 0
    while in_vain < 3:
        loop = max((drawn() for _ in range(40)), key=lambda loop: len(loop.pairs() - met))
        in_vain = 0 if (new := loop.pairs() - met) else in_vain + 1
        loops += [loop] if new else []
        met |= new
    return loops


def ordinary_but_for_one():
    """Each part once in a loop that is ordinary else, and two halves that no strategy compares."""
    loops = [Loop(passes=passes, corrects=False) for passes in PASSES if passes.startswith("two halves")]
    loops += [
        Loop(frozen=names, frozen_from=step)
        for names in dict.fromkeys(FROZEN)
        for step in CHOICES["frozen_from"]
        if names
    ]
    loops += [
        Loop(**{name: value}) for name, values in CHOICES.items() for value in values if not name.startswith("frozen")
    ]
    return dict.fromkeys(loops)


@functools.cache
def scene():
    """The toy scene with SR images of twice the size of the photos."""
    made = toy.scene(20)
    return replace(made, train=tuple(replace(v, hr=v.hr.reduced(2)) for v in made.train))


def separate(splats):
    """An Adam for each parameter."""
    return {name: torch.optim.Adam([p], **ADAM) for name, p in splats.items() if p.is_floating_point()}


class Running:
    """A loop with CLEAR in it."""

    def __init__(self, loop: Loop):
        self.loop, chance = loop, torch.Generator().manual_seed(0)
        self.splats = {
            k: Parameter(x.clone()) for k, x in GaussianField.from_cloud(scene().cloud).raw().items() if k != "detail"
        }
        for name in ("scales", "shN"):  # round Gaussians have no gradient of their rotation
            self.splats[name].data += 0.3 * torch.randn(self.splats[name].shape, generator=chance)
        self.beside = {"offset": Parameter(torch.full((1, 1, 3), 0.1)), "gain": Parameter(torch.full((1,), 0.9)),
                       "shift": Parameter(torch.full((1, 3), 0.01)),
                       "bands": Parameter(0.3 * torch.rand(20, 16, 3, generator=chance))}  # fmt: skip
        one = torch.optim.Adam(self.splats.values(), **ADAM)
        self.optimizers = {"joined": one, "joined in a dictionary": {"all": one}}.get(
            loop.optimizers, separate(self.splats)
        )
        self.conductor = Conductor(*[GCO()] * loop.corrects, objective=HR_FROM_START)
        self.clear = attach(
            self.splats, self.optimizers, scene().train, self.conductor, accumulation=loop.accumulation,
            loss_scale=None if loop.scale == 1 else lambda: loop.scale,
        )  # fmt: skip
        self.splats["detail"].data += 0.2 * torch.randn(20, 3, generator=chance)
        self.function = self.clear.wrap(FUNCTIONS[loop.function])

    def tensors(self):
        return {**{k: p for k, p in self.splats.items() if k != ROWS}, **self.beside}

    def step(self, number: int) -> int:
        """One step of the host; its passes in which a strategy took part. It is compared with the reference before the
        optimizers step.
        """
        loop = self.loop
        if number == loop.frozen_from:
            for name in loop.frozen:
                self.splats[name].requires_grad_(False).grad = None
        brought = 0
        for i in range(loop.accumulation):
            view = scene().train[(number + i) % 3]
            p = self.tensors()
            expected, by_this = reference(loop, self.conductor, {k: copied(x) for k, x in p.items()}, view)
            brought += by_this
            hooks = []
            picture = pictures(loop, self.function, p, hooks)
            loss = loss_of(loop, p, picture(view.lr), view, hooks)
            if loop.rendering == "evaluated between":
                with torch.no_grad():
                    picture(view.lr)
            elif loop.rendering in REFUSED:
                other = loss_of(loop, p, picture(scene().train[(number + i + 1) % 3].lr), view, hooks)
                loss = loss + other if loop.rendering == "two summed" else loss
            with warnings.catch_warnings(action="ignore"):  # of create_graph=True
                PASSES[loop.passes](loss, p)
            compare(loop, p, expected)
            for hook in filter(None, hooks):
                hook.remove()
        passes = self.clear.attachment.state_dict()["passes"]
        assert passes == brought, f"{passes} passes are counted, not {brought}"
        if loop.densified and number == 0:
            self.prune()
        trained = [p for name, p in self.splats.items() if p.grad is not None and bool(p.grad.any())]
        before = [p.detach().clone() for p in trained]
        optimizers = [*self.optimizers.values()] if isinstance(self.optimizers, dict) else [self.optimizers]
        for optimizer in {id(o): o for o in optimizers}.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=not loop.zeros)
        assert not any(torch.equal(p.detach(), b) for p, b in zip(trained, before, strict=True))  # f_det, too
        for p in self.tensors().values():
            p.grad = p.grad if loop.zeros or p.grad is None else None
        if loop.optimizers == "made anew" and number == 0:
            self.optimizers.update(separate(self.splats))
        return brought

    def prune(self):
        """As gsplat's densifiers do: other parameters in the dictionary and in the optimizers."""
        new = {}
        for name, p in self.splats.items():
            self.splats[name] = new[id(p)] = Parameter(p.detach()[1:].clone(), requires_grad=p.requires_grad)
        optimizers = self.optimizers.values() if isinstance(self.optimizers, dict) else [self.optimizers]
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                group["params"] = [new.get(id(p), p) for p in group["params"]]
            optimizer.state.clear()


def copied(x):
    """A leaf of its own with the same gradient, in float64."""
    copy = x.detach().double().requires_grad_(x.requires_grad)
    copy.grad = None if x.grad is None else x.grad.detach().double()
    return copy


def pictures(loop: Loop, function, p, hooks):
    """Draws what a photo's camera sees: colours, alphas and the drawn spherical harmonics; adds the loop's hooks to `hooks`."""
    colors = COLOURS[loop.colours](p)
    made = MEANS[loop.means](p), p["quats"], p["scales"].exp(), OPACITIES[loop.opacities](p), colors
    hooks.append(HOOKS[loop.hook](p, colors))

    def picture(photo, **more):
        c = photo.camera
        view = c.world_to_camera.to(made[0])[None], intrinsics(c).to(made[0])[None], c.width, c.height
        return *function(*made, *view, sh_degree=3, **more)[:2], colors

    return picture


def loss_of(loop: Loop, p, drawn, view, hooks):
    renders, alphas, colors = drawn
    hooks.append(HOOKS[loop.late_hook](p, colors))
    mask = torch.ones(renders.shape[1:3], dtype=torch.bool)
    mask[:, 12:] = False
    image = MASKS[loop.mask](renders, mask)
    loss = photometric(image, view.lr.image.to(image)) + BESIDE[loop.beside](p, colors, alphas)
    return loop.scale / loop.accumulation * loss


def reference(loop: Loop, conductor, p, view):
    """`.grad` of every tensor after a pass, by plain autograd and Eq. 8 in float64; and whether the pass brought a gradient of a
    Gaussian.

    Args:
        p: leaves with what `.grad` was before.
    """
    objective, names = conductor.objective, [name for name in PARAMETERS if p[name].requires_grad]
    before = {name: x.grad for name, x in p.items()}
    picture = pictures(loop, functools.partial(unrecorded, backend="cpp"), p, [])
    image = picture(view.hr, rgb_offset=p["detail"])[0][0]
    beside = "offset", "gain", "shift", "bands"
    of = [p[name] for name in (*names, *beside, "detail")]
    weights = 1, objective.lambda_hf
    base, hf = (
        torch.autograd.grad(image, of, w * c, retain_graph=True, materialize_grads=True, allow_unused=True)
        for w, c in zip(weights, objective.hr(image.detach(), view.hr.image.to(image)).cotangents, strict=True)
    )
    of_all = {name: b + h for name, b, h in zip((*names, *beside), base, hf, strict=False)}
    hr = Grads({name: of_all[name] for name in names})
    for x in p.values():
        x.grad = None
    loss = loss_of(loop, p, picture(view.lr), view, [])
    if not loop.refusal():
        PASSES[loop.passes](loss, p)
    scale = loop.scale / loop.accumulation
    lr = Grads({name: p[name].grad.detach() / scale for name in names if p[name].grad is not None})
    merged = hr = Grads({name: hr[name] for name in lr})
    if loop.corrects and lr:
        merged = conductor.strategies[0].correct(lr, hr, Step(1, view))
    found = {name: scale * (g + merged[name]) for name, g in lr.items()}
    found["detail"] = total(p["detail"].grad, scale * hf[-1] if lr else None)
    found |= {name: total(p[name].grad, scale * of_all[name]) for name in beside if p[name].grad is not None}
    return {name: total(before[name], found.get(name)) for name in p}, bool(lr)


def total(before, found):
    return found if before is None else before if found is None else before + found


def compare(loop, p, expected):
    for name, x in p.items():
        g = expected[name]
        assert (x.grad is None) == (g is None), f"{name}: .grad is {x.grad}, not {g}"
        if g is not None:
            is_drawn = name in PARAMETERS and (name != "opacities" or loop.opacities != "detached")
            assert not (is_drawn and x.grad.requires_grad), f"{name}: .grad has a graph, of LR alone"
            g = g.detach()
            error, size = float((x.grad.detach().double() - g).abs().max()), float(g.abs().max())
            assert error <= 2e-3 * size + 1e-12, f"{name}: {error:.3g} of {size:.3g}"
