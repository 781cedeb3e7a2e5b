"""A whole training run in twenty iterations.

The schedule is compressed so that warm-up, densification, pruning, the opacity reset, the decay of λ_HR and the anchor all
happen: 3 warm-up starts, 2 to 12 densify and prune, 6 and 12 reset, 8 warm, 12 anchor, 14 decay.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import torch

import clear_strategies as cs
from clear_strategies.core.view import DepthMap
from clear_strategies.data.scene import Scene
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay
from clear_strategies.training.compiled_step import FusedMode
from clear_strategies.training.densifier import cameras_extent
from clear_strategies.training.field import GaussianField
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from tests.helpers import toy

ITERATIONS = 20
SCENE = toy.scene(16, seed=2, train=3, test=1)
SUBSETS = [s for k in range(4) for s in itertools.combinations(("gco", "p2g", "svs"), k)]


def _size_that_prunes_the_two_largest() -> float:
    """All are split in the first round, and their children are smaller by 1.6."""
    extent = cameras_extent(SCENE.train)
    sizes = GaussianField.from_cloud(SCENE.cloud).scales.data.exp()[:, 0].sort().values
    return float(sizes[-3]) * 1.001 / 1.6 / extent


PRUNE_WORLD = _size_that_prunes_the_two_largest()


def with_depth(scene: Scene, depth: float = 4.0) -> Scene:
    """The scene with the same depth at every pixel of its training views."""
    shape = SCENE.train[0].lr.image.shape[:2]
    known = DepthMap(torch.full(shape, depth), torch.ones(shape))
    return replace(scene, train=tuple(replace(view, depth=known) for view in scene.train))


def start(
    names: tuple[str, ...], iterations: int = ITERATIONS, *, more: Sequence[cs.Strategy] = (), fused: FusedMode = "auto",
) -> TrainState:  # fmt: skip
    make = {
        "gco": cs.GCO, "p2g": cs.P2G,
        "svs": lambda: cs.SVS(
            dropout=Ramp(full=ITERATIONS), anchor_start=12, anchor_strength=0.01,
            anchor_weights={"means": 1.0, "scales": 1.0, "sh0": 0.1, "detail": 0.1},
        ),
        "pseudo_views": lambda: cs.PseudoViews(count=8, reach=0.1),
        "fading_opacity": lambda: cs.FadingOpacity(rate=0.02, until=1_350),
        "random_background": lambda: cs.RandomBackground(until=1_350),
    }  # fmt: skip
    objective = cs.Objective(lambda_hr=WarmupDecay(final=0.1, start=3, full=8, decay_from=14, end=ITERATIONS))
    return TrainState.start(
        with_depth(SCENE) if "pseudo_views" in names else SCENE,
        cs.Conductor(*(make[name]() for name in names), *more, objective=objective, statistics_from=1),
        settings=FitSettings(
            iterations=iterations, scale_schedule=False, degree_every=6, probe_every=0, checkpoint_every=0, seed=5,
            fused=fused,
        ),
        density=DensitySettings(
            start=1, stop=13, statistics_from=1, every=5, reset_every=6, threshold=1e-5, prune_opacity=0.005,
            prune_world=PRUNE_WORLD, min_gaussians=2, max_gaussians=40,
        ),
        rates=LearningRates(means=LogLinear(end=ITERATIONS), detail_decay=0.01),
        mip=MipFilter(every=7, last=1),
    )  # fmt: skip


def tensors(state: TrainState) -> dict[str, torch.Tensor]:
    return dict(state.checkpoint({}).tensors)
