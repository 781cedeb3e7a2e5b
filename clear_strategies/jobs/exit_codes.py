"""Exit codes of the process, and one-line messages of errors.

0: done. 2: a setting, a file or a sweep's job cannot be used, or memory ran out. 3: the disk is full or read-only.
128 + n: stopped by signal n. Any other error is a bug: Python shows its traceback, and exits with 1; in a sweep the other
jobs go on.
"""

from __future__ import annotations

import errno
from importlib.util import find_spec
from typing import Final, NamedTuple

from clear_strategies import signals
from clear_strategies.errors import ClearError, SettingError, one_line

_NO_MEMORY: Final = "can't allocate memory"  # of torch's allocator on the CPU
_NO_SLURM: Final = 'Could not detect "srun"'  # of submitit
_JOB_ENDED: Final = "has not produced any output"  # of submitit, where Slurm has ended a job without SIGUSR2
_LESS_MEMORY: Final = (
    "Raise `ulimit -v` where it is set. Lower density.max_gaussians or raise data.views.shrink; rasterizer.memory bounds the "
    "rasterizer's lists. Of clear-strategies render: lower --width."
)

# A remedy that is named before "elsewhere", by the system's error number; without access, a photo's folder may be meant.
_FIRST: Final = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "Free space, or write"),
    errno.EACCES: "Allow access to it, or write",
}

UNUSABLE: Final = 2
NO_DISK: Final = 3
SIGNALS: Final = 128

# What needs an extra, and the modules that it installs, by its name.
NEEDED: Final = {
    "train": ("training", (
        "cv2", "filelock", "jinja2", "kornia", "matplotlib", "msgspec", "pandas", "psutil", "safetensors", "scipy", "skimage",
        "tqdm",
    )),
    "view": ("the viewer", ("viser", "nerfview", "splines")),
}  # fmt: skip


class Ending(NamedTuple):
    """The exit code of a process, and its message."""

    code: int
    message: str


def describe(error: BaseException) -> Ending | None:
    """The message and exit code of an error that the user can solve; None for a bug."""
    if signals.told and not isinstance(error, signals.Interrupted | KeyboardInterrupt):
        error = KeyboardInterrupt(signals.told[0])  # an error after a signal is a consequence of it
    if isinstance(error, ClearError):
        return Ending(error.exit_code, one_line(error))
    if isinstance(error, KeyboardInterrupt):
        signum = signals.signal_of(error)
        return Ending(SIGNALS + signum, f"stopped by {signum.name}.")  # the job itself has logged what it saved
    # Not at the top: a wrong argument is refused without waiting for torch.
    from rasterizers.interface import BackendUnavailable, OutdatedKernels

    if isinstance(error, BackendUnavailable | OutdatedKernels):
        return Ending(UNUSABLE, one_line(error))
    if message := _of_machine(error):
        return Ending(UNUSABLE, message)
    disk = error if isinstance(error, OSError) else error.__cause__  # logging wraps it if it cannot open its file
    if isinstance(disk, OSError):
        where = one_line(f"{disk.filename or 'output'}: {disk.strerror or disk}")
        remedy = f"{_FIRST.get(disk.errno or 0, 'Write')} elsewhere"
        folders = "hydra.run.dir=FOLDER of a run, hydra.sweep.dir=FOLDER of a sweep"
        elsewhere = f"{folders}, --out of a command, $CLEAR_CACHE of the cache"
        return Ending(NO_DISK, f"{where}. {remedy} ({elsewhere}). Earlier checkpoints, if any, are untouched.")
    return None


def _of_machine(error: BaseException) -> str | None:
    """The message if the machine has no Slurm or has ended a job, or if memory ran out, or may have; None for other errors."""
    if isinstance(error, RuntimeError) and _NO_SLURM in str(error):
        return (
            "hydra/launcher: there is no Slurm on this machine (no srun). Start the command on a node of its cluster."
        )
    if isinstance(error, RuntimeError) and _JOB_ENDED in str(error):
        return (
            "a job of the sweep was ended, as by scancel. Finished jobs stay; the others go on from their checkpoints with "
            "fit.resume=auto and the same hydra.sweep.dir."
        )
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _NO_MEMORY in str(error)):
        return f"out of memory: {one_line(error) or 'Python had none left.'} {_LESS_MEMORY}"
    if isinstance(error, ImportError) and "failed to map segment" in str(error):  # of a library, by the system
        why = "memory is limited to too little (raise `ulimit -v`), or its folder's disk runs no programs (noexec)"
        return f"{one_line(error)}: {why}."
    return None


def require(extra: str) -> None:
    """Raise a SettingError if a library of this extra of `NEEDED` is not installed. Imports none of them."""
    what, modules = NEEDED[extra]
    if missing := [name for name in modules if find_spec(name) is None]:
        raise SettingError(f"{what} needs {', '.join(missing)}: pip install 'clear-strategies[{extra}]'.")
