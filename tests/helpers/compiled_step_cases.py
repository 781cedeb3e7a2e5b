"""Random gradients of one view, for comparing the compiled per-Gaussian step with the readable path."""

import itertools
from dataclasses import dataclass, replace
from functools import partial

import pytest
import torch

from clear_strategies import SVS, Conductor, Evidence, Grads, Objective
from clear_strategies.core import deferred
from clear_strategies.core.gradients import gradients_of
from clear_strategies.merging.iteration import HrSide
from clear_strategies.schedules import WarmupDecay
from clear_strategies.training import compiled_step
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.field import FieldShot, GaussianField
from clear_strategies.training.optim import Adam, LearningRates
from rasterizers.interface import SplatGradients
from tests.helpers import toy

T = 5  # any iteration between `full` and `decay_from`
HR_LOSSES = ("none", "base", "both")
ATTRIBUTES = ("means", "quats", "scales", "opacities", "screen", "rgb")
ALWAYS = WarmupDecay(start=0, full=1, decay_from=10, end=10)
HALF = replace(ALWAYS, peak=0.5, final=0.5)


def as_floats(numbers) -> dict[str, float]:
    """The numbers as floats, read from the device where they are deferred."""
    return dict(zip(numbers, deferred.read(list(numbers.values())), strict=True))


@dataclass
class Case:
    """One view's gradients, and two equal fields: one for the readable path, one for the compiled step.

    Args:
        hr: of L_base and L_HF. weight: λ_HF m.
    """

    fields: tuple[GaussianField, GaussianField]
    lr: SplatGradients
    hr: SplatGradients
    weight: torch.Tensor
    e: Evidence | None
    z: torch.Tensor | None

    def factors(self, use: int, hr: str = "both") -> tuple:
        """What a compiled step is given: the rendering, g_LR and what comes from HR."""
        shot = object.__new__(FieldShot)
        shot.activation = self.fields[use]._activate(self.z)
        (lr,) = gradients_of(self.lr)
        of_hr = {"none": [], "base": gradients_of(self.hr)[:1], "both": gradients_of(self.hr.summed(self.weight))}
        return shot, lr, self._side(of_hr[hr])

    def grads(self, use: int, hr: str = "both") -> tuple:
        """The same for the readable path."""
        a = self.fields[use]._activate(self.z)
        base, (both, detail) = gradients_of(self.hr)[0], gradients_of(self.hr.summed(self.weight))
        of_hr = {"none": [], "base": [a.vjp(base)], "both": [a.vjp(both), detail]}
        return a.vjp(gradients_of(self.lr)[0]), self._side(of_hr[hr])

    def _side(self, of_hr) -> HrSide | None:
        g, detail, *_ = *of_hr, None, None
        return None if g is None else HrSide(g, detail, (1, 1), toy.step(evidence=self.e))


def readable_merge(conductor, params, g_lr, hr, t) -> tuple:
    """The merged gradient and the conflict ratios of the readable path."""
    g_hr, step = (Grads(), None) if hr is None else (hr.routed, hr.step)
    merged = conductor.merge(params, g_lr.without_detail(), g_hr, step, t)
    return merged.grads, merged.conflict


def compiled_merge(step: CompiledStep, c: Case, hr: str = "both") -> tuple:
    """The merged gradient of a compiled step, which Adam's first moment is where β₁ = 0, and the conflict ratios."""
    params = {name: p.clone() for name, p in c.fields[1].raw().items()}
    step.optimizer = Adam(params, LearningRates(), 1.0)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(compiled_step, "BETA1", 0.0)
        conflict = step.step(params, *c.factors(1, hr), T)
    return step.optimizer.first, conflict


ANCHORING = partial(
    SVS, anchor_strength=0.01,
    anchor_weights={"means": 1.0, "scales": 1.0, "quats": 1.0, "opacities": 0.1, "sh0": 0.01, "shN": 0.01, "detail": 0.0},
)  # fmt: skip


def case(n=1000, degree=3, kind="random", seed=0, bands=15, gate=False, evidence=True) -> Case:
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g)

    parameters = {
        "means": normal(n, 3), "quats": normal(n, 4), "scales": normal(n, 3) - 3, "opacities": normal(n) * 3,
        "sh0": normal(n, 1, 3), "shN": normal(n, bands, 3) * 0.1, "detail": normal(n, 3) * 0.1,
    }  # fmt: skip
    parameters["shN"][:, (degree + 1) ** 2 - 1 :] = 0
    fields = tuple(GaussianField(parameters, degree=degree) for _ in range(2))
    filter_3d = torch.rand(n, generator=g) * 0.05
    for field in fields:
        field.filter_3d = filter_3d.clone()
    basis = normal(n, (degree + 1) ** 2)
    rows = {"random": 1e-5, "tiny": 1e-30, "huge": 1e20}.get(kind, 1e-5) * torch.ones(n)
    if kind == "mixed":
        rows = 10.0 ** (torch.rand(n, generator=g) * 50 - 30)

    def gradients(k):
        def rowed(*shape):
            return normal(k, n, *shape) * rows.view(1, n, *[1] * len(shape))

        return SplatGradients(rowed(3), rowed(4), rowed(3), rowed(), rowed(2), rowed(3), basis)

    lr, hr = gradients(1), gradients(2)
    if kind in ("opposite", "parallel"):
        sign = -1.0 if kind == "opposite" else 1.0
        hr = SplatGradients(
            *(getattr(lr, f).repeat(2, *[1] * (getattr(lr, f).dim() - 1)) * sign for f in ATTRIBUTES), basis
        )
    if kind == "sparse":  # most Gaussians are invisible, and some have a gradient of one loss alone
        for gradient, k in ((lr, 0), (hr, 0), (hr, 1)):
            invisible = torch.rand(n, generator=g) > 0.2
            for name in ATTRIBUTES:
                getattr(gradient, name)[k, invisible] = 0
    if kind == "zero":
        for s, name in itertools.product((lr, hr), ATTRIBUTES):
            getattr(s, name).zero_()
    if kind == "round":  # equal axes: rotation gradients are rounding
        lr.quats.mul_(2.0**-30)
    weight = 0.2 * (0.25 + 0.75 * torch.rand(n, generator=g) if evidence else torch.ones(n))
    e = Evidence(torch.rand(n, generator=g), torch.rand(n, generator=g)) if evidence else None
    z = (torch.rand(n, generator=g) > 0.2).float() / 0.8 if gate else None
    return Case(fields, lr, hr, weight, e, z)


def conductors(*makers, anchored=None, λ=HALF) -> tuple[Conductor, Conductor]:
    """Two equal conductors; if `anchored` is given, with an anchor that differs a little from that field."""
    makers = [ANCHORING if make is SVS else make for make in makers]
    both = tuple(Conductor(*(make() for make in makers), objective=Objective(lambda_hr=λ)) for _ in "ab")
    for conductor in both:
        conductor.on_fit_start(3, 0)
        for s in conductor.strategies:
            if isinstance(s, SVS) and anchored is not None:
                s.after_step({name: p * 1.01 for name, p in anchored.raw().items()}, toy.step(s.anchor_start))
    return both
