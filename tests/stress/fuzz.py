"""Random damage to the binary formats: what comes back is sound or a DataError, at once and in little memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from clear_strategies.data import ply
from clear_strategies.data.readers import colmap_model, llff
from clear_strategies.errors import DataError
from clear_strategies.training import checkpoint
from tests.helpers.malformed import GOOD
from tests.stress.checkpoints import small
from tests.stress.rows import Row, Worst

_SECONDS = 0.1  # that one input may take


def mutant(good: bytes, rng: np.random.Generator) -> bytes:
    """One to three edits: a bit flipped, bytes overwritten, repeated, removed, or the rest cut off."""
    data = bytearray(good)
    for _ in range(rng.integers(1, 4)):
        at, length = int(rng.integers(max(1, len(data)))), int(rng.integers(1, 9))
        match rng.integers(8):
            case 0 | 1 | 2 if data:
                data[at] ^= 1 << int(rng.integers(8))
            case 3 | 4:
                data[at : at + length] = bytes([int(rng.choice([0, 0x7F, 0x80, 0xFF]))]) * length
            case 5:
                data[at:at] = data[at : at + length]
            case 6:
                del data[at : at + length]
            case _:
                if rng.integers(4) == 0:
                    del data[at:]
    return bytes(data)


def targets(folder: Path) -> dict[str, tuple[Path, Callable[[], None]]]:
    """Format -> the file to damage, and what reads it and checks what comes back."""
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


def measure(folder: Path, mutants: int, seed: int = 0) -> list[Row]:
    """How many mutants of each format gave an unsound result, another error, or took too long."""
    rows = []
    for name, (file, read) in targets(folder).items():
        good, rng, bad = file.read_bytes(), np.random.default_rng(seed), Worst()
        for i in range(mutants):
            file.write_bytes(mutant(good, rng))
            bad.add(_fails(read), f"mutant {i} of seed {seed}")
        file.write_bytes(good)
        rows.append(bad.row(f"damaged {name}: unsound, untyped or slow", "all", 0))
    return rows


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
