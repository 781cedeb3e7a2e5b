"""Random damage to the files that are read: what comes back is sound or a DataError, at once and in little memory."""

import io
import logging
import math
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cache
from itertools import islice, repeat
from pathlib import Path

import torch

from clear_strategies.data import ply
from clear_strategies.data.capture import Capture, SfmPoints
from clear_strategies.data.lenses import Lens
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.readers import colmap, colmap_model, nerfstudio
from clear_strategies.errors import DataError
from clear_strategies.training import checkpoint
from tests.helpers.captures import GOOD
from tests.stress.faults import small
from tests.stress.rows import Row

_SECONDS = 0.1  # that one input may take
_MEMORY = 2**30  # bytes beyond those of before
_EXTREMES = (b"\0", b"\x7f", b"\x80", b"\xff")
_LONGEST = 8  # bytes of one edit

Target = tuple[Sequence[Path], Callable[[], None]]
"""The files of which one is damaged, and what reads them and checks what comes back."""
Targets = Callable[[Path], dict[str, Target]]
"""Writes good files to a folder: format -> target."""


def mutants(name: str, good: Sequence[bytes]) -> Iterator[tuple[int, bytes]]:
    """(which of the `good` files, its damaged content), without end; the same ones each time."""
    rng = random.Random(name)  # noqa: S311 - no secret
    while True:
        which = int(rng.random() * len(good))
        yield which, _mutant(good[which], rng.random)


def _mutant(good: bytes, uniform: Callable[[], float]) -> bytes:
    """One to three edits: a bit flipped, bytes overwritten, repeated, removed, or the rest cut off."""
    data = bytearray(good)
    for _ in range(1 + int(3 * uniform())):
        if not data:
            break
        at, length, edit = int(uniform() * len(data)), 1 + int(uniform() * _LONGEST), 8 * uniform()
        if edit < 3:
            data[at] ^= 1 << int(uniform() * 8)
        elif edit < 5:
            data[at : at + length] = _EXTREMES[int(uniform() * len(_EXTREMES))] * length
        elif edit < 6:
            data[at:at] = data[at : at + length]
        elif edit < 7:
            del data[at : at + length]
        elif uniform() < 0.25:
            del data[at:]
    return bytes(data)


def binary(folder: Path) -> dict[str, Target]:
    """Each binary format by its own reader."""
    model = GOOD["colmap"](folder / "colmap") / "sparse" / "0"
    cameras, images, points = (model / f"{name}.bin" for name in ("cameras", "images", "points3D"))
    cloud = folder / "cloud.ply"
    ply.write_gaussians(cloud, _gaussians(20))
    saved = checkpoint.save(folder / "checkpoints", small(100, 1.0))

    def read_gaussians() -> None:
        found = ply.read_gaussians(cloud)
        _require(bool(found.means.isfinite().all()) and len(found.opacities) == len(found.means))

    def read_checkpoint() -> None:
        found = checkpoint.load(saved)
        _require(bool((found.tensors["field/means"] == 1.0).all()) and found.t == 100)

    return {
        "COLMAP cameras.bin": ([cameras], lambda: _require_lenses(colmap_model.read_cameras(cameras, {1}).values())),
        "COLMAP images.bin": ([images], lambda: _require_images(colmap_model.read_images(images))),
        "COLMAP points3D.bin": ([points], lambda: _require_points(colmap_model.read_points(points))),
        "PLY": ([cloud], read_gaussians),
        "checkpoint": ([saved], read_checkpoint),
    }


def text(folder: Path) -> dict[str, Target]:
    """Text files by their own readers; and PNG, whose decoder is a library."""
    model = GOOD["colmap_txt"](folder / "txt") / "sparse" / "0"
    cameras, images, points = (model / f"{name}.txt" for name in ("cameras", "images", "points3D"))
    photo, shared = GOOD["colmap"](folder / "photo") / "images" / "b.png", GOOD["nerfstudio"](folder / "nerfstudio")

    def read_photo() -> None:
        image = read_image(photo)
        _require(image.dim() == 3 and bool(image.isfinite().all()))

    return {
        "COLMAP cameras.txt": ([cameras], lambda: _require_lenses(colmap_model.read_cameras(cameras, {1}).values())),
        "COLMAP images.txt": ([images], lambda: _require_images(colmap_model.read_images(images))),
        "COLMAP points3D.txt": ([points], lambda: _require_points(colmap_model.read_points(points))),
        "transforms.json": ([shared / "transforms.json"], lambda: _require_capture(nerfstudio.read(shared))),
        "PNG": ([photo], read_photo),
    }


def scenes(folder: Path) -> dict[str, Target]:
    """Whole scenes, one file of which is damaged: the parts must fit together. Reading one takes a millisecond and more."""

    def target(kind: str, read: Callable[[Path], Capture]) -> Target:
        root = GOOD[kind](folder / kind)
        files = [path for path in sorted(root.rglob("*")) if path.is_file() and "images" not in path.parent.name]
        return files, lambda: _require_capture(read(root))

    return {
        "COLMAP binary scene": target("colmap", colmap.read),
        "COLMAP text scene": target("colmap_txt", colmap.read),
    }


def _gaussians(n: int) -> ply.GaussianPly:
    numbers = torch.linspace(-1, 1, n * 3).view(n, 3)
    rest = numbers[:, None].repeat(1, 3, 1)
    return ply.GaussianPly(numbers, numbers[:, None], rest, numbers[:, 0], numbers, torch.ones(n, 4))


def _require_lenses(lenses: Iterable[Lens]) -> None:
    for lens in lenses:
        _require(0 < lens.width < 2**20 and 0 < lens.height < 2**20 and lens.fx > 0 and lens.fy > 0)
        _require(all(map(math.isfinite, (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion))))


def _require_images(images: Sequence[colmap_model.Image]) -> None:
    for image in images:
        _require(all(map(math.isfinite, image.translation)) and 0.5 < math.hypot(*image.quat) < 2)
    _require(len({image.id for image in images}) == len(images))


def _require_points(points: SfmPoints) -> None:
    n = len(points.means)
    _require(bool(points.means.isfinite().all()) and len(points.colors) == n)
    _require(not len(points.track_point) or 0 <= int(points.track_point.min()) <= int(points.track_point.max()) < n)


def _require_capture(capture: Capture) -> None:
    for frame in capture.frames:
        rotation = frame.camera.world_to_camera[:3, :3]
        _require(float((rotation @ rotation.T - torch.eye(3).to(rotation)).abs().max()) < 1e-6)
    if capture.points is not None:
        _require(bool(capture.points.means.isfinite().all()))
        _require(set(capture.points.track_image.tolist()) <= {frame.sfm_id for frame in capture.frames})


def measure(targets: Targets, count: int) -> Row:
    """How many of the first `count` mutants of each format gave an unsound result, another error, or took too much.

    Each format is read in a process of its own, without the checks of types that tests run with. All are forked off one that has
    imported this module.
    """
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload([__name__])
    names, failed, first = list(_written(targets)[1]), 0, "none"
    with ProcessPoolExecutor(os.cpu_count(), mp_context=processes) as pool:
        for name, (n, where) in zip(names, pool.map(damaged, repeat(targets), names, repeat(count)), strict=True):
            failed, first = failed + n, f"{name}: {where}" if n and not failed else first
    what = f"damaged files, {targets.__name__}: unsound, untyped or slow"
    return Row(what, "all", count * len(names), float(failed), 0, first)


def damaged(targets: Targets, name: str, count: int) -> tuple[int, str]:
    """How many of a format's first `count` mutants failed, and which was the first."""
    paths, read = _written(targets)[1][name]
    read()  # the first call imports and allocates what later ones do not
    good, failed, first = [path.read_bytes() for path in paths], 0, "none"
    with _bounded_memory(), _without_messages(), ExitStack() as stack:
        files = [stack.enter_context(path.open("r+b", buffering=0)) for path in paths]
        for i, (which, data) in enumerate(islice(mutants(name, good), count)):
            _replace(files[which], data)
            if _fails(read):
                failed, first = failed + 1, f"mutant {i}" if failed == 0 else first
            _replace(files[which], good[which])
    return failed, first


@cache
def _written(targets: Targets) -> tuple[tempfile.TemporaryDirectory[str], dict[str, Target]]:
    """The targets, in a folder that is removed when the process ends; in memory where the system has such folders."""
    memory = "/dev/shm"  # noqa: S108 - a name of its own is made in it
    folder = tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None)
    return folder, targets(Path(folder.name))


def _replace(file: io.FileIO, data: bytes) -> None:
    file.seek(0)
    file.write(data)
    file.truncate()


@contextmanager
def _without_messages() -> Iterator[None]:
    """A warning for each mutant takes longer than the mutant."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


@contextmanager
def _bounded_memory() -> Iterator[None]:
    """A reader that allocates by a damaged count then fails here, and not the machine."""
    if sys.platform != "linux":  # no /proc; macOS does not enforce the limit
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _fails(read: Callable[[], None]) -> bool:
    for _ in range(2):  # a second time where the first took long, in which the machine may have done something else
        began = time.process_time()
        try:
            read()
        except DataError:
            pass
        except Exception:
            return True
        if time.process_time() - began <= _SECONDS:
            return False
    return True


def _require(holds: bool) -> None:
    if not holds:
        raise RuntimeError("a damaged file was read as if it were whole")
