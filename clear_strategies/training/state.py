"""Everything that changes while training, and its checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from clear_strategies.core import deferred
from clear_strategies.core.finite import is_finite, rows_not_finite
from clear_strategies.core.view import View
from clear_strategies.data.scene import Scene
from clear_strategies.errors import AnswerError, DataError, DivergedError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.skips import Plateau
from clear_strategies.signatures import signature_of
from clear_strategies.strategies.base import Strategy
from clear_strategies.training.checkpoint import Checkpoint
from clear_strategies.training.compiled_step import CompiledStep, compiled_step_for
from clear_strategies.training.densifier import Densifier, DensifierSettings, cameras_extent
from clear_strategies.training.field import GaussianField
from clear_strategies.training.history import History
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from rasterizers.interface import Rasterizer, RasterSettings, Splats
from rasterizers.replays import Replays

_log = logging.getLogger(__name__)

_RULES: Final = RasterSettings()
PHOTOS: Final = "photos"
"""The prefix of `fingerprints` in a checkpoint."""
_CELLS: Final = 16  # a side


def fingerprints(scene: Scene) -> dict[str, Tensor]:
    """A fingerprint of each view by its name, by which a resumed run recognises its photos: means in a grid of red, green, blue,
    the mask and 1 - alpha; for training views also of the square of the SR image, since back-projection gives all SR images of a
    photo the same means. Pixels that are hidden or not finite count as black.
    """
    found: dict[str, Tensor] = {}
    for view in (*scene.train, *scene.test):
        image, mask, transparency = view.lr.image, view.lr.shown, view.lr.transparency
        shown = torch.ones_like(image[..., 0]) if mask is None else mask.to(image)
        through = torch.zeros_like(shown) if transparency is None else transparency
        found[view.name] = _means(torch.cat([image * shown[..., None], shown[..., None], through[..., None]], dim=-1))
    return found | {v.name: torch.cat([found[v.name], _means(v.hr.image.square())]) for v in scene.train}


def _means(layers: Float[Tensor, "H W C"]) -> Float[Tensor, "C h w"]:
    return adaptive_avg_pool2d(torch.nan_to_num(layers, 0.0, 0.0, 0.0).permute(2, 0, 1), _CELLS).cpu()


def _densifier_of(owner: Strategy | DensifierSettings, *arguments: Any) -> Any:
    """Settings of an older version, say, take other arguments."""
    try:
        signature_of(owner.densifier).bind(*arguments)
    except TypeError as error:
        rule = f"must take (field, views, seed), got {signature_of(owner.densifier)}"
        raise AnswerError(f"{type(owner).__name__}.densifier() {rule}. See Strategy.densifier.") from error
    return owner.densifier(*arguments)


@dataclass(slots=True)
class TrainState:
    """Everything that changes while training, on the device of the views.

    Args:
        t: the next iteration, from 1.
        rules: the settings of the rasterizer.
        history: one row per iteration; read it by `history_as_floats`, since on a device its numbers are deferred.
        photos: the scene's `fingerprints`.
        replays: the recordings of iterations, if these are replayed (`fit.replay`); no checkpoint needs them.
    """

    field: GaussianField
    conductor: Conductor
    optimizer: Adam
    density: Densifier
    settings: FitSettings
    mip: MipFilter
    views: tuple[View, ...]
    rules: RasterSettings = _RULES
    t: int = 1
    history: History = field(default_factory=History)
    compiled_step: CompiledStep | None = None
    photos: Mapping[str, Tensor] = field(default_factory=dict)
    replays: Replays | None = None

    @classmethod
    def start(
        cls,
        scene: Scene,
        conductor: Conductor,
        *,
        settings: FitSettings,
        density: DensifierSettings,
        rates: LearningRates,
        mip: MipFilter,
        rules: RasterSettings = _RULES,
        rasterizer: Rasterizer | None = None,
    ) -> TrainState:
        """The state before the first iteration, on the device of the scene's views.

        Args:
            settings, density, rates, mip: with milestones already scaled to this run.
            density: of the densifier, unless a strategy brings its own.
            rules: of the rasterizer that draws. rasterizer: itself, for strategies that draw.
        """
        device = scene.device
        theta = GaussianField.from_cloud(scene.cloud, max_degree=settings.max_degree).to(device)
        owner: Strategy | DensifierSettings | None = conductor.owner("densifier")
        densifier = None if owner is None else _densifier_of(owner, theta, scene.train, settings.seed)
        if densifier is None:
            owner, densifier = density, _densifier_of(density, theta, scene.train, settings.seed)
        if not isinstance(densifier, Densifier):
            rule = f"must give a {Densifier.__module__}.Densifier{'' if owner is density else ' or None'}"
            raise AnswerError(f"{type(owner).__name__}.densifier() {rule}, got {densifier!r:.80}.")
        optimizer = Adam(theta.raw(), rates, cameras_extent(scene.train))
        photos = fingerprints(scene)
        state = cls(theta, conductor, optimizer, densifier, settings, mip, scene.train, rules, photos=photos)

        def splats(raw: Mapping[str, Tensor]) -> Splats:
            return state.field.splats_of(raw)  # a checkpoint brings another field

        conductor.on_fit_start(len(scene.train), settings.seed, device, scene.train, splats, rasterizer)
        state.compiled_step = compiled_step_for(conductor, optimizer, settings.fused)
        state.refilter()
        return state

    @property
    def device(self) -> torch.device:
        """The device of the field, and of all other tensors per Gaussian or pixel."""
        return self.field.means.device

    def history_as_floats(self) -> Sequence[dict[str, float]]:
        """The history with every number read."""
        return deferred.resolve(self.history)

    @property
    def seconds(self) -> float:
        """Seconds of training until the last iteration, those before a resume included."""
        return self.history_as_floats()[-1]["seconds"] if self.history else 0.0

    @property
    def ended(self) -> bool:
        return self.t > self.settings.iterations

    @property
    def plateau(self) -> Plateau:
        return Plateau(self.conductor.skips.skips, len(self.views))

    def advance(self) -> None:
        """Go to the next iteration, or from a plateau of the training views straight to its end."""
        done, self.t = self.t, self.t + 1
        if not self.plateau.reached(self.history, done):
            return
        self.t = min(self.plateau.skips.plateau_to, self.settings.iterations) + 1
        left_out = self.t - done - 1
        self.optimizer.steps += left_out  # the learning rates follow the iteration
        self.conductor.work_log.skip("iterations", str(self.plateau), left_out)
        _log.info("no progress: skipping from iteration %d to %d, since %s.", done, self.t, self.plateau)

    def refilter(self) -> None:
        cameras = [(v.hr if self.mip.cameras == "hr" else v.lr).camera for v in self.views]
        self.field.update_filter(cameras, self.mip.variance, self.rules.near)

    def remove_undrawn(self) -> bool:
        """Once densification has ended, remove the Gaussians that no view draws, see `Skips.undrawn`; returns whether there
        were any. They would never return, since their gradient is 0.
        """
        if not self.density.settled(self.t):
            return False
        conductor, n = self.conductor, len(self.field)
        drawn = conductor.skips.drawn(self.field.filtered_opacities(), self.rules.alpha_min)
        if drawn is None or conductor.pulls(self.field.raw(), self.t):
            return False
        conductor.work_log.skip("Gaussians", "too faint to be drawn (skips.undrawn)", n - len(drawn))
        _log.debug("t=%d: %d too faint to be drawn: %d -> %d Gaussians.", self.t, n - len(drawn), n, len(drawn))
        self.field.take(drawn)
        self.optimizer.take(drawn, torch.zeros_like(drawn, dtype=torch.bool))
        self.density.gather(drawn)
        self.resized(drawn)
        return True

    def restructure(self) -> bool:
        """Let the densifier change the structure, if it is due at t; returns whether it did.

        Raises:
            AnswerError: the densifier changed the structure without calling `resized`. A Gaussian that moves to another row is
                noticed on a CPU only.
        """
        n, name, calls = len(self.field), f"{type(self.density).__name__}.step()", list[int]()
        colours = self.field.sh0.data.clone() if self.device.type == "cpu" else None  # they identify Gaussians

        def resized(parents: Int[Tensor, " M"]) -> None:
            nonlocal colours
            calls.append(len(parents))
            if len(parents) != len(self.field):
                rule = f"must call resized(parents) with the {len(self.field):,} rows that the field has then"
                raise AnswerError(f"{name} {rule}, got {len(parents):,}.")
            self.resized(parents)
            colours = None if colours is None else colours[parents]

        changed = self.density.step(self.field, self.optimizer, self.t, resized)
        if not calls and (changed or len(self.field) != n):
            change = f"a change of structure, here from {n:,} to {len(self.field):,} Gaussians"
            raise AnswerError(f"{name} must call resized(parents) after {change}.")
        if colours is not None and (moved := self._moved(colours)) is not None:
            row, parent = moved
            rule = "must call resized(parents) where it moves Gaussians, too, after gathering field and optimizer by parents"
            raise AnswerError(f"{name} {rule}: row {row} is now a copy of row {parent}, so parents[{row}] is {parent}.")
        return bool(calls)

    def _moved(self, colours: Float[Tensor, "N 1 3"]) -> tuple[int, int] | None:
        """A row that has become a copy of another row, and that row; None: there is none.

        Args:
            colours: sh0 of each row, according to the densifier.
        """
        now, quats = self.field.sh0.data, self.field.quats.data
        if torch.equal(now, colours):
            return None
        row = int((now != colours).flatten(1).any(1).nonzero()[0])
        same = (colours == now[row]).flatten(1).all(1) & (quats == quats[row]).all(1)  # others may have its colour
        return (row, int(same.nonzero()[0])) if bool(same.any()) else None

    def resized(self, parents: Int[Tensor, " M"]) -> None:
        """Complete a change of structure in which row i of field and optimizer came from row parents[i]: gather what strategies
        store per Gaussian, and recompute the filter.
        """
        self.conductor.on_resize(parents)
        self.refilter()

    def reset_due(self, t: int) -> bool:
        """Return True if opacities are lowered at t, see `Densifier.reset_due`."""
        return self.conductor.may_densify(t) and self.density.reset_due(t)

    def filter_due(self) -> bool:
        """Return True if the 3D filter is recomputed at t; every change of structure also recomputes it."""
        return self.t % self.mip.every == 0 and self.t <= self.settings.iterations - self.mip.last

    def checkpoint(self, config: Mapping[str, Any]) -> Checkpoint:
        """The checkpoint of this state."""
        self.require_finite()
        tables = {**self._tables(), "strategies": self.conductor.state_dict(), PHOTOS: self.photos}
        tensors = {f"{prefix}/{name}": value for prefix, table in tables.items() for name, value in table.items()}
        facts = {"optimizer_steps": float(self.optimizer.steps), "degree": float(self.field.degree)}
        history, work_log = self.history_as_floats(), self.conductor.work_log.state_dict()
        return Checkpoint(self.t, tensors, config, facts, history, work_log, self.device.type)

    def restore(self, saved: Checkpoint, source: Path) -> None:
        """Continue from a checkpoint, which may come from another device."""
        tables: dict[str, dict[str, Tensor]] = {}
        for name, value in saved.tensors.items():
            prefix, _, rest = name.partition("/")
            tables.setdefault(prefix, {})[rest] = value
        try:
            parameters, device = tables["field"], self.device
            self._require_rows(tables, saved)
            self.field = GaussianField(parameters, degree=int(saved.facts["degree"])).to(device)
            self.field.filter_3d = parameters["filter_3d"].to(device, copy=True)
            self.optimizer.load_state_dict(tables["optimizer"], int(saved.facts["optimizer_steps"]))
            self.density.load_state_dict(tables.get("density", {}))
            self.conductor.load_state_dict(tables.get("strategies", {}))
            self.conductor.work_log.load_state_dict(saved.work_log)
        except (KeyError, ValueError, TypeError) as error:
            raise DataError(
                source, "tensors", f"do not fit this run ({error})", "resume with the run's own config"
            ) from error
        self.t = saved.t
        self.history = History(dict(row) for row in saved.history)

    def _tables(self) -> dict[str, Mapping[str, Tensor]]:
        """The tensors that this trainer's own parts store, by the name of the part."""
        field = {**self.field.raw(), "filter_3d": self.field.filter_3d}
        return {"field": field, "optimizer": self.optimizer.state_dict(), "density": self.density.state_dict()}

    def _require_rows(self, tables: Mapping[str, Mapping[str, Tensor]], saved: Checkpoint) -> None:
        """Check that all restored tensors have a row for each Gaussian, and the width and type that this run has."""
        if not (1 <= saved.t <= self.settings.iterations + 1 and saved.facts["degree"] <= self.field.max_degree):
            raise ValueError(f"t={saved.t} and degree={saved.facts['degree']:g} do not occur in it")
        n = len(tables["field"]["means"])
        for part, own in self._tables().items():
            for name, here in own.items():
                x, shape = tables[part][name], (n, *here.shape[1:])
                if here.dim() and len(here) == len(self.field) and (x.dtype, x.shape) != (here.dtype, shape):
                    raise ValueError(f"{name} is {x.dtype} {tuple(x.shape)}, not {here.dtype} {shape}")

    def require_finite(self) -> None:
        """Raise a DivergedError for the first parameter or moment of Adam that is not finite; reads the device."""
        moments = ("first moment of ", self.optimizer.first), ("second moment of ", self.optimizer.second)
        for kind, table in (("", self.field.raw()), *moments):
            for name, value in table.items():
                if not is_finite(value):
                    raise DivergedError(
                        f"before t={self.t}: {kind}{name} {rows_not_finite(value)}. The last checkpoint is from before "
                        "that; lower the learning rates."
                    )
