"""A scene small enough for a test: a few random Gaussians, seen from an arc, at LR 24x16 and HR 96x64."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import rasterizers
from clear_strategies import Conductor, Evidence, ExtraView, Objective, Photo, Step, Strategy, View, Weights
from clear_strategies.core import images
from clear_strategies.core.conflicts import Products
from clear_strategies.core.points import PointCloud
from clear_strategies.data.scene import Scene
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.training.field import GaussianField
from clear_strategies.training.mip import NEAR, MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers import Camera, Splats
from rasterizers.interface import RasterSettings

FACTOR = 4
RASTERIZER = rasterizers.load(rasterizers.fastest("cpu"))
"""Where it is compiled, it draws ten times as fast as the reference, with which tests/rasterizers compares it."""


def camera(angle: float, width: int = 96, height: int = 64) -> Camera:
    """Four units from the origin, looking at it, `angle` radians to the side."""
    c, s = math.cos(angle), math.sin(angle)
    pose = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 4], [0, 0, 0, 1.0]])
    return Camera(pose, fx=width * 1.1, fy=width * 1.1, cx=width / 2, cy=height / 2, width=width, height=height)


def splats(n: int = 40, seed: int = 0, dtype: torch.dtype = torch.float32, bands: int = 3) -> Splats:
    """Anisotropic Gaussians of mixed opacity in a box around the origin."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g).to(dtype)

    return Splats(
        means=normal(n, 3) * torch.tensor([1.1, 0.7, 0.8], dtype=dtype), quats=normal(n, 4),
        scales=(normal(n, 3) * 0.5 - 1.8).exp(), opacities=torch.sigmoid(normal(n) + 1), sh0=normal(n, 1, 3),
        shN=normal(n, bands, 3) * 0.2,
    )  # fmt: skip


def scene(n: int = 40, seed: int = 0, train: int = 3, test: int = 1) -> Scene:
    """Views of `splats`; the SR image is the truth with noise of its own in each view."""
    truth = splats(n, seed)
    views = []
    for i in range(train + test):
        hr_camera = camera(-0.3 + 0.6 * i / (train + test - 1))
        image = images.quantize(RASTERIZER(truth, hr_camera).image)
        noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(100 * seed + i)) * 0.03
        lr = Photo(hr_camera.scaled(1 / FACTOR), images.downsample(image, FACTOR))
        hr = Photo(hr_camera, images.quantize(image + noise))
        views.append(View(f"view{i}", lr, hr, truth=image, sr_source="truth with noise"))
    g = torch.Generator().manual_seed(seed + 7)
    means = truth.means + torch.randn(n, 3, generator=g) * 0.05
    cloud = PointCloud(means, torch.rand(n, 3, generator=g), source="toy")
    # The held-out view lies between training views.
    held = set(range(1, 2 * test, 2))
    return Scene(
        "toy", train=tuple(v for i, v in enumerate(views) if i not in held),
        test=tuple(v for i, v in enumerate(views) if i in held), cloud=cloud,
    )  # fmt: skip


def cloud(n: int = 12, seed: int = 0) -> PointCloud:
    g = torch.Generator().manual_seed(seed)
    return PointCloud(torch.randn(n, 3, generator=g), torch.rand(n, 3, generator=g), "random")


def step(t: int = 1, evidence: Evidence | None = None, visible: Tensor | None = None) -> Step:
    """An iteration on a view that nobody looks at; Gaussians with evidence are visible unless `visible` says otherwise."""
    photo = Photo(Camera(torch.eye(4), 8.0, 8.0, 4.0, 4.0, 8, 8), torch.zeros(8, 8, 3))
    if visible is None and evidence is not None:
        visible = torch.ones(len(evidence.demand), dtype=torch.bool)
    return Step(t, View("toy", photo, photo), visible, evidence)


@dataclass(frozen=True)
class Shows(Strategy):
    """Shows the field what a function makes of its training views in an iteration."""

    shown: Callable[[Sequence[View], int], Sequence[ExtraView]]

    def on_views(self, views: Sequence[View]) -> None:
        self.__dict__["views"] = views  # which is nothing that it stores, as a replay asks

    def extra_views(self, t: int) -> Sequence[ExtraView]:
        return self.shown(self.__dict__["views"], t)


def again(photo: Photo, weight: float = 1.0, **settings: Any) -> ExtraView:
    """A photo as an extra view, with this weight at every pixel."""
    return ExtraView(photo, torch.full_like(photo.image[..., 0], weight), **settings)


@dataclass(frozen=True)
class ShowsDark(Strategy):
    """Shows the field a black picture at every iteration, by a camera that no photo has: moved, turned, off its centre."""

    def on_views(self, views: Sequence[View]) -> None:
        camera, a = views[0].lr.camera, 0.05
        moved = torch.eye(4)
        moved[:3, :3] = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
        moved[:3, 3] = torch.tensor([0.2, -0.1, 0.3])
        aside = replace(
            camera, world_to_camera=moved @ camera.world_to_camera.float(), fx=camera.fx * 1.1, cx=camera.cx - 1.5,
            cy=camera.cy + 0.5, width=camera.width - 2,
        )  # fmt: skip
        black = Photo(aside, torch.zeros(aside.height, aside.width, 3))
        self.cache["extra"] = ExtraView(black, torch.ones(aside.height, aside.width))

    def extra_views(self, t: int) -> Sequence[ExtraView]:
        return (self.cache["extra"],)


def densifier(settings: DensitySettings, field: GaussianField | int) -> Any:
    """Density control in a scene of extent 1, of a field or of one with so many Gaussians."""
    field = GaussianField.from_cloud(cloud(field)) if isinstance(field, int) else field
    made = settings.densifier(field, [step().view], 0)
    made.extent = 1.0
    return made


class Operations(TorchDispatchMode):
    """How many operations there were by name, but for those that are views."""

    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[str] = Counter()

    def __torch_dispatch__(self, operation, types, arguments=(), keywords=None):
        self.count[operation.overloadpacket.__name__] += not operation.is_view
        return operation(*arguments, **(keywords or {}))


@dataclass(frozen=True)
class Recorder(Strategy):
    """Records every change of structure."""

    changes: list[Tensor] = field(default_factory=list)

    def on_resize(self, parents: Tensor) -> None:
        self.changes.append(parents)


@dataclass(frozen=True)
class RunningMean(Strategy):
    """Stores a number of the run."""

    def reconcile(self, products: Products, step: Step | None) -> Weights:
        return Weights(keep=self.state.get("mean", 1.0))

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        mean = self.state.setdefault("mean", torch.zeros(()))
        mean.lerp_(params["means"].square().mean(), 0.1)


def started(
    *strategies: Strategy, objective: Objective | None = None, of: Scene | None = None, near: float = NEAR, **settings: object
) -> TrainState:  # fmt: skip
    """A run on the toy scene, or on another, before its first iteration; the readable path unless `settings` say otherwise."""
    return TrainState.start(
        of or scene(), Conductor(*strategies, objective=objective or Objective(kernels="torch")),
        settings=FitSettings(**{"iterations": 10, "probe_every": 0, "max_degree": 1, "fused": "off", **settings}),
        density=DensitySettings(), rates=LearningRates(), mip=MipFilter(), rules=RasterSettings(near=near),
    )  # fmt: skip
