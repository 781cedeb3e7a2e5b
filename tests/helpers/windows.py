"""A stand-in for Windows: a Python process on Linux in which this package's code is refused what Windows refuses.

What other libraries ask of the system stays as it is, since they have code of their own for Windows: modules are changed as our
modules see them. Of the files below one folder, the disk, the rules hold for everybody. Paths keep their slashes, and a file is
found by its exact name alone.
"""

import builtins
import errno
import fcntl
import multiprocessing
import os
import re
import signal
import stat
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, Final

_OURS: Final = ("clear_strategies", "conf", "integration", "rasterizers")
_DISK: Final = "WINDOWS_DISK"  # the environment's variable that names the folder
_PLACE: Final = r"C:\Users\somebody\Documents"  # of the disk
_LONGEST: Final = 259  # characters of a path, where the registry allows no more
ILLEGAL: Final = re.compile(r'[<>:"|?*\\\x00-\x1f]|[. ]\Z|\A(con|prn|aux|nul|com\d|lpt\d)\s*(\.|\Z)', re.IGNORECASE)
# Compiled modules: a wheel of pure Python has none.
_KERNELS: Final = re.compile(r"(clear_strategies|rasterizers)\..*_(avx2|avx512|baseline)")
_NO_MODULE: Final = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "termios", "tty")
_ABSENT: Final = {
    "mmap": "MAP_ANON MAP_ANONYMOUS MAP_PRIVATE MAP_SHARED PROT_EXEC PROT_READ PROT_WRITE",
    "os": "O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK WNOHANG chown fork getgid getloadavg getpgid getuid killpg mkfifo nice "
    "posix_fadvise posix_spawn pread pwrite sched_getaffinity sendfile setsid statvfs sync sysconf uname wait wait3 wait4",
    "signal": "SIGALRM SIGHUP SIGKILL SIGPIPE SIGQUIT SIGUSR1 SIGUSR2 alarm pause pthread_kill pthread_sigmask setitimer sigwait",
    "socket": "AF_UNIX send_fds",
    "time": "tzset",
}
BREAK: Final = signal.SIGVTALRM  # stands for SIGBREAK, and ends a process as that does
_SIGNALS: Final = {signal.SIGABRT, signal.SIGFPE, signal.SIGILL, signal.SIGINT, signal.SIGSEGV, signal.SIGTERM, BREAK}


def program(*arguments: str, disk: Path) -> tuple[list[str], dict[str, str]]:
    """Command and environment of a Python program that begins in the folder `disk`, and passes the rules on to its processes."""
    from tests.helpers.command_line import environment  # which the program itself has no use for

    site = disk.parent / f"{disk.name}_site"
    site.mkdir(exist_ok=True)
    (site / "sitecustomize.py").write_text("from tests.helpers import windows\nwindows.begin()\n")
    env = environment(disk)
    own = {_DISK: str(disk), "PYTHONPATH": f"{site}{os.pathsep}{env['PYTHONPATH']}", "PYTHONIOENCODING": "cp1252"}
    return [sys.executable, *arguments], {**env, **own, "PYTHONWARNDEFAULTENCODING": "1"}


def run(*arguments: str, disk: Path) -> subprocess.CompletedProcess[str]:
    """The program to its end."""
    command, env = program(*arguments, disk=disk)
    return subprocess.run(command, check=False, cwd=disk, env=env, capture_output=True, encoding="cp1252", timeout=600)


def begin() -> None:
    """From here on this process is on Windows."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    own: dict[str, dict[str, Any]] = {
        "multiprocessing": {"get_all_start_methods": lambda: ["spawn"]},
        "os": {"fsync": _fsync, "kill": _kill, "name": "nt", "open": _open},
        "signal": {"CTRL_BREAK_EVENT": 1, "CTRL_C_EVENT": 0, "SIGBREAK": BREAK, "signal": _set_handler},
        "sys": {"platform": "win32"},
        "threading": {"Event": _Event},
    }
    seen = {name: _Seen(__import__(name), _ABSENT.get(name, ""), own.get(name, {})) for name in {*_ABSENT, *own}}
    really, rename = builtins.__import__, os.rename

    def importing(name: str, within: Any = None, local: Any = None, fromlist: Any = (), level: int = 0) -> Any:
        ours = level == 0 and ((within or {}).get("__package__") or "").partition(".")[0] in _OURS
        if ours and name in _NO_MODULE:
            raise ModuleNotFoundError(f"No module named {name!r}")
        module = really(name, within, local, fromlist, level)
        return seen.get(name, module) if ours else module

    def renaming(source: Any, target: Any, **more: Any) -> None:
        if _on_disk(target) and os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, "Cannot create a file when that file already exists", str(target))
        rename(source, target, **more)

    builtins.__import__, os.rename = importing, renaming
    sys.meta_path.insert(0, _Checkout)  # type: ignore[arg-type]
    multiprocessing.set_start_method("spawn", force=True)
    warnings.filterwarnings("ignore", category=EncodingWarning)
    warnings.filterwarnings("error", category=EncodingWarning, module="|".join(_OURS))  # the text would be cp1252
    sys.addaudithook(_watch)


class _Seen(ModuleType):
    """A module as it is on Windows."""

    def __init__(self, module: ModuleType, absent: str, own: dict[str, Any]) -> None:
        super().__init__(module.__name__)
        vars(self).update(_module=module, _absent=absent.split(), **own)

    def __getattr__(self, name: str) -> Any:
        if name in self._absent:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r} on Windows")
        return getattr(self._module, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._module, name, value)


class _Checkout:
    @staticmethod
    def find_spec(name: str, path: Any, *_: Any) -> ModuleSpec | None:
        if _KERNELS.fullmatch(name):
            raise ModuleNotFoundError(f"No module named {name!r}")
        return PathFinder.find_spec(name, path) if name.partition(".")[0] in _OURS else None


class _Event(threading.Event):
    def wait(self, timeout: float | None = None) -> bool:
        if timeout is None:
            raise RuntimeError("Ctrl-C does not end a wait without a timeout on Windows")
        return super().wait(timeout)


def _fsync(descriptor: int) -> None:
    if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, "Bad file descriptor")
    os.fsync(descriptor)


def _open(path: Any, flags: int, *more: Any, **options: Any) -> int:
    if Path(path).is_dir():
        raise PermissionError(errno.EACCES, "Permission denied", str(path))
    return os.open(path, flags, *more, **options)


def _kill(pid: int, number: int) -> None:
    """Only Ctrl-C and Ctrl-Break are sent, to all processes of a console; whatever else ends the process."""
    os.kill(pid, {0: signal.SIGINT, 1: BREAK}.get(number, signal.SIGKILL))


def _set_handler(number: int, handler: Any) -> Any:
    if number not in _SIGNALS:
        raise ValueError("signal number is not one of Windows")
    return signal.signal(number, handler)


def _watch(event: str, given: tuple[Any, ...]) -> None:
    """The rules of a disk."""
    if event == "open" and given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        _require_legal(_on_disk(given[0]))
    elif event == "os.mkdir":
        _require_legal(_on_disk(given[0], given[2]))
    elif event == "os.remove":
        _require_free(_on_disk(given[0], given[1]))
    elif event == "os.rename":
        for path in (_on_disk(given[0], given[2]), _on_disk(given[1], given[3])):
            _require_free(path)
            _require_legal(path)
    elif event in ("os.symlink", "os.link") and (path := _on_disk(given[1])):
        raise OSError(errno.EPERM, "A required privilege is not held by the client", path)


def _on_disk(path: Any, folder: int | None = None) -> str | None:
    """The absolute path, of one on the disk."""
    if isinstance(path, int) or path is None:
        return None
    base = Path.cwd() if folder in (None, -1) else Path(f"/proc/self/fd/{folder}").readlink()
    whole = os.path.normpath(base / os.fsdecode(path))
    return whole if whole.startswith(os.environ[_DISK] + os.sep) else None


def _require_legal(path: str | None) -> None:
    if path is None:
        return
    inside, folder = Path(path).relative_to(os.environ[_DISK]), Path(path).parent
    if any(map(ILLEGAL.search, inside.parts)):
        raise OSError(errno.EINVAL, "The filename, directory name, or volume label syntax is incorrect", path)
    if len(f"{_PLACE}/{inside}") > _LONGEST:
        raise FileNotFoundError(errno.ENOENT, "The system cannot find the path specified", path)
    others = {other.name for other in folder.iterdir()} - {inside.name} if folder.is_dir() else ()
    if any(other.lower() == inside.name.lower() for other in others):
        raise RuntimeError(f"{path}: a name that differs in case alone is the same file on Windows")


def _require_free(path: str | None) -> None:
    if path is not None and any(held == path or held.startswith(path + os.sep) for held in _held()):
        raise PermissionError(errno.EACCES, "The process cannot access the file, another process is using it", path)


def _held() -> Iterator[str]:
    """The files that this process and those that it has started hold open, or map."""
    pids, own = ["self"], Path("/proc/self/cmdline").read_bytes()
    for task in Path("/proc/self/task").glob("*/children"):
        with suppress(OSError):  # the thread has ended meanwhile
            pids += task.read_text(encoding="utf-8").split()
    for pid in pids:
        with suppress(OSError):  # ended meanwhile
            if pid != "self" and Path(f"/proc/{pid}/cmdline").read_bytes() in (b"", own):
                continue  # between fork and exec it has this process's files, of which a program of Windows is given none
            for link in Path(f"/proc/{pid}/fd").glob("*"):
                with suppress(OSError):  # closed meanwhile
                    if stat.S_ISREG(link.stat().st_mode):
                        yield str(link.readlink())
    yield from re.findall(r" (/.*)$", Path("/proc/self/maps").read_text(encoding="utf-8"), re.MULTILINE)
