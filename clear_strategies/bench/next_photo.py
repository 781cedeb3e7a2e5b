"""Does the advice pay: train on a few photos, and add the photo nearest to the places that `next_photos` names, or another one.

The test views are the scene's. Each training is a process of its own; one whose metrics.json is there is read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import torch

from clear_strategies.bench.results import Results
from clear_strategies.bench.seconds import Trainer, train
from clear_strategies.compose import composed, tree
from clear_strategies.data.capture import Frame
from clear_strategies.data.view_settings import evenly_spaced, split
from clear_strategies.errors import DataError
from clear_strategies.jobs.saved import open_splat
from clear_strategies.jobs.scene import read
from clear_strategies.jobs.settings import settings_of
from clear_strategies.outputs import metrics
from clear_strategies.outputs.next_photos import next_photos
from rasterizers.interface import Camera

_PLAIN: Final = ("fit.map_views=0", "fit.video=0", "fit.page=0")


@dataclass(frozen=True, slots=True)
class Request:
    """The options of the command line."""

    overrides: Sequence[str]
    scene: Sequence[str]
    start: int
    others: int
    seed: int
    out: Path


def measure(results: Results, request: Request, trainer: Trainer = train) -> None:
    """Fill `results` with the PSNR of the test views before and after each addition.

    Raises:
        DataError: a training failed, or a scene has too few photos.
    """
    rows = [_of_scene(results, request, scene, trainer) for scene in request.scene]
    results.tables["next_photo"] = pd.DataFrame(rows)
    shared = " ".join(override for override in request.overrides if "/" not in override)
    results.note(f"PSNR of the scene's test views, dB; all trainings: {shared or 'defaults'}")


def _of_scene(results: Results, request: Request, scene: str, trainer: Trainer) -> dict[str, Any]:
    frames = _photos(request, scene)
    if len(frames) < request.start + 2:
        remedy = "lower --start, or take another scene"
        raise DataError(scene, "photos", f"{len(frames)} are no test photos, {request.start + 2} are needed", remedy)
    first = evenly_spaced(list(frames.values()), request.start)
    left = [frame for frame in frames.values() if frame not in first]

    def psnr(*added: Frame) -> float:
        return _trained(request, scene, [*first, *added], trainer)

    before = psnr()
    splat = open_splat(_folder(request, scene, first))
    poses = dict(zip((frame.name for frame in first), splat.poses(), strict=True))
    places = [(p.camera, float(splat.painter.depth(p.camera).nanmedian())) for p in next_photos(poses, splat.painter)]
    if not places:
        raise DataError(scene, "next photos", "the field shows nothing", "train longer: fit.iterations")
    advised = min(left, key=lambda frame: min(_apart(frame.camera, camera, focus) for camera, focus in places))
    gained = psnr(advised) - before
    drawn = np.random.default_rng(request.seed).permutation(len(left))[: request.others]
    others = [psnr(left[i]) - before for i in drawn]
    told = (
        f"{scene}: {before:.2f} dB, {advised.name} gives {gained:+.2f}, others {', '.join(f'{o:+.2f}' for o in others)}"
    )
    results.log(told)
    return {
        "scene": scene, "photos": request.start, "before": before, "advised": advised.name, "advised_gain": gained,
        "others": len(others), "others_gain": float(np.mean(others)), "others_least": min(others),
        "others_most": max(others), "share_below": float(np.mean([gained > other for other in others])),
    }  # fmt: skip


def _photos(request: Request, scene: str) -> Mapping[str, Frame]:
    """The photos of a scene that are not its test photos, by their stems."""
    settings = settings_of(tree(composed([f"+scene={scene}", *request.overrides], "config")))
    capture, views = read(settings.data, settings.prior)
    pool, test = split(capture, replace(views, train_names=None, train=None))
    return {Path(frame.name).stem: frame for frame in pool if frame not in test}


def _folder(request: Request, scene: str, frames: Sequence[Frame]) -> Path:
    names = "_".join(re.sub(r"\W+", "", Path(frame.name).stem)[-12:] for frame in frames)
    return request.out / f"{scene}_{names}"


def _trained(request: Request, scene: str, frames: Sequence[Frame], trainer: Trainer) -> float:
    """The PSNR of a training on these photos, dB."""
    folder = _folder(request, scene, frames)
    if not (folder / "metrics.json").is_file():
        names = ",".join(f"'{Path(frame.name).stem}'" for frame in frames)
        overrides = [f"+scene={scene}", *_PLAIN, *request.overrides, f"data.views.train_names=[{names}]"]
        if (problem := trainer(folder, overrides)) is not None:
            raise DataError(folder.name, "training", problem, "see its log")
    found = metrics.read(folder / "metrics.json", "remove the folder")
    return metrics.as_float(found.test.mean["ours"].psnr)


def _apart(camera: Camera, place: Camera, focus: float) -> float:
    """How far a camera is from a place, in distances to what is looked at from there, plus the angle between both, radians."""
    moved = float(torch.linalg.vector_norm(camera.center.double() - place.center.double())) / focus
    turn = (camera.world_to_camera[2, :3].double() * place.world_to_camera[2, :3].double()).sum()
    return moved + float(turn.clamp(-1, 1).acos())
