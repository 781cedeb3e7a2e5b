"""Random damage to the files that are read: what comes back is sound or a DataError, at once and in little memory."""

from __future__ import annotations

import random
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from clear_strategies.data import ply
from clear_strategies.data.capture import Capture
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.readers import colmap, colmap_model, llff, nerfstudio
from clear_strategies.errors import DataError
from clear_strategies.training import checkpoint
from tests.helpers.malformed import GOOD
from tests.stress.faults import small
from tests.stress.rows import Row, Worst

_SECONDS = 0.1  # that one input may take
_MEMORY = 2**30  # bytes beyond those of before
_EXTREMES = (b"\0", b"\x7f", b"\x80", b"\xff")


def mutant(good: bytes, rng: random.Random) -> bytes:
    """One to three edits: a bit flipped, bytes overwritten, repeated, removed, or the rest cut off."""
    data = bytearray(good)
    for _ in range(rng.randint(1, 3)):
        at, length = rng.randrange(max(1, len(data))), rng.randint(1, 8)
        match rng.randrange(8):
            case 0 | 1 | 2 if data:
                data[at] ^= 1 << rng.randrange(8)
            case 3 | 4:
                data[at : at + length] = rng.choice(_EXTREMES) * length
            case 5:
                data[at:at] = data[at : at + length]
            case 6:
                del data[at : at + length]
            case _:
                if rng.randrange(4) == 0:
                    del data[at:]
    return bytes(data)


Target = tuple[Path, Callable[[], None]]


def binary(folder: Path) -> dict[str, Target]:
    """Binary format -> the file to damage, and what reads it and checks what comes back."""
    scene, table = GOOD["colmap"](folder / "colmap"), GOOD["llff"](folder / "llff")
    model = scene / "sparse" / "0"

    def read_colmap() -> None:
        found = colmap_model.read_model(model)
        for image in found.images:
            pose = colmap_model.pose_of(image)
            _require(bool(pose.isfinite().all()) and image.camera in found.lenses)
        _require(bool(np.isfinite(found.points.means).all()))

    cloud = folder / "cloud.ply"
    n = 20
    numbers = torch.linspace(-1, 1, n * 3).view(n, 3)
    ply.write_gaussians(
        cloud,
        ply.GaussianPly(
            numbers, numbers[:, None], numbers[:, None].repeat(1, 3, 1), numbers[:, 0], numbers, torch.ones(n, 4)
        ),
    )

    def read_ply() -> None:
        found = ply.read_gaussians(cloud)
        _require(bool(found.means.isfinite().all()) and len(found.opacities) == len(found.means))

    saved = checkpoint.save(folder / "checkpoints", small(100, 1.0))

    def read_checkpoint() -> None:
        found = checkpoint.load(saved)
        _require(bool((found.tensors["field/means"] == 1.0).all()) and found.t == 100)

    return {
        **{f"COLMAP {name}.bin": (model / f"{name}.bin", read_colmap) for name in ("cameras", "images", "points3D")},
        "poses_bounds.npy": (
            table / "poses_bounds.npy",
            lambda: _require(llff.read(table, poses="poses_bounds") is not None),
        ),
        "PLY": (cloud, read_ply),
        "checkpoint manifest": (saved / "manifest.json", read_checkpoint),
        "checkpoint tensors": (saved / "tensors.safetensors", read_checkpoint),
    }


def scenes(folder: Path) -> dict[str, Target]:
    """Text and images, read as parts of a whole scene, which takes a millisecond and more."""
    text, shared = GOOD["colmap_txt"](folder / "txt"), GOOD["nerfstudio"](folder / "nerfstudio")
    photo = GOOD["colmap"](folder / "photo") / "images" / "b.png"

    def read_photo() -> None:
        image = read_image(photo)
        _require(image.dim() == 3 and bool(image.isfinite().all()))

    return {
        **{f"COLMAP {name}.txt": (text / "sparse" / "0" / f"{name}.txt", lambda: _require_sound(colmap.read(text)))
           for name in ("cameras", "images", "points3D")},
        "transforms.json": (shared / "transforms.json", lambda: _require_sound(nerfstudio.read(shared))),
        "PNG": (photo, read_photo),
    }  # fmt: skip


def _require_sound(capture: Capture) -> None:
    for frame in capture.frames:
        rotation = frame.camera.world_to_camera[:3, :3]
        _require(float((rotation @ rotation.T - torch.eye(3).to(rotation)).abs().max()) < 1e-6)
    if capture.points is not None:
        _require(bool(capture.points.means.isfinite().all()))
        _require(set(capture.points.track_image.tolist()) <= {frame.sfm_id for frame in capture.frames})


def measure(targets: dict[str, Target], mutants: int, *, seed: int = 0, goal: int = 0) -> Iterator[Row]:
    """How many mutants of each format gave an unsound result, another error, took too long or too much memory."""
    with _bounded_memory():
        for name, (file, read) in targets.items():
            good, rng, bad = file.read_bytes(), random.Random(seed), Worst()  # noqa: S311 - no secret
            for i in range(mutants):
                file.write_bytes(mutant(good, rng))
                bad.add(_fails(read), f"mutant {i} of seed {seed}")
            file.write_bytes(good)
            yield bad.row(f"damaged {name}: unsound, untyped or slow", "all", 0, goal)


@contextmanager
def _bounded_memory() -> Iterator[None]:
    """A reader that allocates by a damaged count then fails here, and not the machine."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _fails(read: Callable[[], None]) -> float:
    began = time.process_time()
    try:
        read()
    except DataError:
        pass
    except Exception:
        return 1.0
    return float(time.process_time() - began > _SECONDS)


def _require(holds: bool) -> None:
    if not holds:
        raise RuntimeError("a damaged file was read as if it were whole")
