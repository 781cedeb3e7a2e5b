"""Every operation on files of a save, of an export and of a resumed run fails once in each way that a disk or a kill has.

Afterwards a checkpoint is whole, every other file is as before or as it was to become, and the next start leaves no rest.
"""

import errno
import io
import os
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from clear_strategies import DataError, files
from clear_strategies.data.photo_files import write_png
from clear_strategies.outputs.results import export_ply
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import Checkpoint
from clear_strategies.training.field import GaussianField
from clear_strategies.viewing.cameras import write_cameras
from tests.helpers import toy
from tests.stress.rows import Row, Worst, failures


class Killed(BaseException):
    """The process is gone: no operation after it happens either."""


FAULTS: dict[str, Callable[[], BaseException]] = {
    "kill": Killed,
    "ENOSPC": lambda: OSError(errno.ENOSPC, "No space left on device"),
    "EIO": lambda: OSError(errno.EIO, "Input/output error"),
    "EACCES": lambda: PermissionError(errno.EACCES, "Permission denied"),
    "short write": lambda: OSError(errno.EFBIG, "File too large"),
}


class _Disk:
    """Counts operations, and fails the `at`-th; after a kill all later ones fail."""

    def __init__(self, at: int, make: Callable[[], BaseException]) -> None:
        self.at, self.make, self.seen, self.dead = at, make, list[str](), False

    def count(self, name: str) -> None:
        if self.dead:
            raise Killed
        self.seen.append(name)
        if len(self.seen) == self.at:
            error = self.make()
            self.dead = isinstance(error, Killed)
            raise error

    def wrapped(self, name: str, real: Callable) -> Callable:
        def call(*arguments, **options):
            self.count(name)
            return real(*arguments, **options)

        return call

    def opened(self, real: Callable) -> Callable:
        def call(path, mode="r", *arguments, **options):
            if set(mode) & set("wxa+"):
                self.count("open")
                return _File(self, real(path, mode, *arguments, **options))
            return real(path, mode, *arguments, **options)

        return call

    def remove_tree(self, path, ignore_errors=False, **_) -> None:
        """As shutil.rmtree, in operations that each may fail."""
        try:
            for entry in sorted(Path(path).iterdir()):
                entry.unlink()
            Path(path).rmdir()
        except OSError:
            if not ignore_errors:
                raise


class _File:
    """An open file whose writes may fail, and then leave half of the bytes."""

    def __init__(self, disk: _Disk, file: io.IOBase) -> None:
        self._disk, self._file = disk, file

    def write(self, data):
        try:
            self._disk.count("write")
        except BaseException:
            self._file.write(data[: len(data) // 2])
            self._file.flush()
            raise
        return self._file.write(data)

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self._file.close()

    def __getattr__(self, name: str):
        return getattr(self._file, name)


@contextmanager
def fault(at: int, make: Callable[[], BaseException]) -> Iterator[list[str]]:
    """Let the `at`-th operation on files fail. Yields the operations by name."""
    disk = _Disk(at, make)
    patched = [(Path, name) for name in ("mkdir", "rename", "replace", "unlink", "rmdir")] + [(os, "fsync")]
    own = [(io, "open"), (shutil, "rmtree")]
    before = [(owner, name, getattr(owner, name)) for owner, name in (*patched, *own)]
    for owner, name, real in before[: -len(own)]:
        setattr(owner, name, disk.wrapped(name, real))
    io.open = disk.opened(io.open)  # what Path.open calls
    shutil.rmtree = disk.remove_tree
    try:
        yield disk.seen
    finally:
        for owner, name, real in before:
            setattr(owner, name, real)


def small(t: int, value: float) -> Checkpoint:
    facts = {"optimizer_steps": float(t), "degree": 1.0}
    tensors = {"field/means": torch.full((5, 3), value)}
    work = {"render LR": {"runs": t, "seconds": 1.5, "skipped": {"why": 2}}}
    return Checkpoint(t, tensors, {"fit.seed": 1}, facts, [{"t": 1.0, "loss": 0.25}], work)


_SCENE = toy.scene(6, train=2, test=1)


def _write_all(folder: Path, value: float) -> None:
    """The files of a finished run that are no checkpoint, small."""
    write_cameras(folder, _SCENE)
    field = GaussianField.from_cloud(_SCENE.cloud, max_degree=1)
    field.detail.data.fill_(value)
    export_ply(folder / "point_cloud.ply", field)
    write_png(folder / "renders" / "view1.png", _SCENE.test[0].lr.image * value)
    files.write_text(folder / "history.csv", f"t,loss\n1.0,{value}\n")
    files.write_json(folder / "metrics.json", {"psnr": value})


@dataclass(frozen=True)
class Scenario:
    """Work on the files of a run.

    Args:
        prepare: makes the run's folder as it was. act: the work.
    """

    name: str
    prepare: Callable[[Path], object]
    act: Callable[[Path], object]


def _first(folder: Path, keep: int = 1, *, exported: bool = False) -> None:
    checkpoint.save(folder / "checkpoints", small(100, 1.0), keep=keep)
    if exported:
        _write_all(folder, 0.25)


def _died(folder: Path) -> None:
    """A process died while it saved and while it exported."""
    _first(folder, exported=True)
    (folder / "checkpoints" / ".step_0000200.7.partial").mkdir()
    (folder / "checkpoints" / ".step_0000200.7.partial" / ".tmpQ7").write_text("[")
    (folder / ".metrics.json.7.partial").write_text("{")


def _save(folder: Path, keep: int, iterations: Sequence[int]) -> None:
    for i, t in enumerate(iterations, 2):
        checkpoint.save(folder / "checkpoints", small(t, float(i)), keep=keep)


def _export(folder: Path) -> None:
    _write_all(folder, 0.75)


def _resume(folder: Path, keep: int = 1) -> None:
    files.sweep(folder)
    found = checkpoint.load(folder)
    _save(folder, keep, [found.t + 100, found.t + 200])
    _export(folder)


def _saving(name: str, keep: int, *iterations: int) -> Scenario:
    act = partial(_save, keep=keep, iterations=iterations)
    return Scenario(f"{name}, keep={keep}", partial(_first, keep=keep), act)


SCENARIOS = [
    *(_saving("save", k, 200) for k in (1, 3)),
    *(_saving("save the same step again", k, 100) for k in (1, 3)),
    *(_saving("three saves", k, 200, 300, 400) for k in (1, 2)),
    Scenario("first export", _first, _export),
    Scenario("export over another", partial(_first, exported=True), _export),
    *(Scenario(f"resumed run, keep={k}", partial(_first, keep=k, exported=True), partial(_resume, keep=k)) for k in (1, 2, 3)),
    Scenario("resumed after a death", _died, _resume),
]  # fmt: skip


def measure(folder: Path, *, most: int | None = None) -> Row:
    """Every operation of every scenario fails in every way.

    Args:
        most: of the fault points, evenly chosen; None: all.
    """
    flush = os.fsync
    os.fsync = lambda descriptor: None  # a disk's own cache is not part of this, and waiting for it is most of the time
    try:
        return failures(
            _outcomes(folder, most),
            "fault points of save, export, resume: a checkpoint lost, a torn file, a rest",
            "all",
        )
    finally:
        os.fsync = flush


def _outcomes(folder: Path, most: int | None) -> Iterator[tuple[str, str | None]]:
    """The scenario and the operation that failed, and what was not whole afterwards."""
    points = list(_points(folder))
    step = 1 if most is None else max(1, len(points) // most)
    for scenario, kind, at, states in points[::step]:
        run_folder = folder / "run"
        scenario.prepare(run_folder)
        with fault(at, FAULTS[kind]) as seen, suppress(OSError, Killed):
            scenario.act(run_folder)
        where = f"{scenario.name}: {kind} at {seen[-1]} {at}"
        yield where, None if _whole(run_folder, states) else "not whole"
        shutil.rmtree(run_folder)


States = dict[str, set[bytes]]


def _points(folder: Path) -> Iterator[tuple[Scenario, str, int, States]]:
    """Every fault point, and what each file that is no checkpoint may hold afterwards."""
    for scenario in SCENARIOS:
        run_folder = folder / "whole"
        scenario.prepare(run_folder)
        states: States = {}
        _add_contents(run_folder, states)
        with fault(0, Killed) as seen:
            scenario.act(run_folder)
        _add_contents(run_folder, states)
        shutil.rmtree(run_folder)
        for kind in FAULTS:
            for at, name in enumerate(seen, 1):
                if kind != "short write" or name == "write":
                    yield scenario, kind, at, states


def _add_contents(folder: Path, states: States) -> None:
    for name, content in _contents(folder).items():
        states.setdefault(name, set()).add(content)


def _contents(folder: Path) -> dict[str, bytes]:
    found = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in found.items() if not name.startswith("checkpoints")}


def _whole(folder: Path, states: States) -> bool:
    """Whether the next start finds a checkpoint, no torn file, and no rest of a write."""
    files.sweep(folder)
    try:
        found = [checkpoint.load(path) for path in checkpoint.saved(folder / "checkpoints")]
    except DataError:
        return False
    values = [saved.tensors["field/means"] for saved in found]
    rests = [path for path in folder.rglob("*") if ".partial" in path.name]
    known = all(content in states.get(name, ()) for name, content in _contents(folder).items())
    sound = all(bool((x == x[0, 0]).all()) and float(x[0, 0]) in (1.0, 2.0, 3.0, 4.0) for x in values)
    return bool(found) and sound and known and not rests


def integrity(folder: Path, most: int) -> Row:
    """Single bits flipped, and files cut short: each is a DataError.

    Args:
        most: of the bits, chosen at random; all of them where there are fewer.
    """
    path = checkpoint.save(folder, small(100, 1.0))
    good, accepted = path.read_bytes(), Worst()
    bits = range(8 * len(good))
    for bit in bits if len(bits) <= most else random.Random(0).sample(bits, most):  # noqa: S311 - no secret
        data = bytearray(good)
        data[bit // 8] ^= 1 << bit % 8
        accepted.add(_accepts(path, bytes(data)), f"bit {bit}")
    for length in range(0, len(good), max(1, 40 * len(good) // most)):
        accepted.add(_accepts(path, good[:length]), f"cut to {length} bytes")
    return accepted.row("checkpoints with a flipped bit or cut short: accepted, or another error", "all", 0)


def _accepts(path: Path, data: bytes) -> float:
    path.write_bytes(data)
    try:
        checkpoint.load(path)
    except DataError:
        return 0.0
    except Exception:
        return 1.0
    return 1.0
