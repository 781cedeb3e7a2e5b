"""Files and settings made to run something, to read or write elsewhere, or to fill the machine: refused, without a trace.

A trace is a canary, another program, a connection, or a file opened outside the folder of the attack: an audit hook sees it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from clear_strategies.data import ply
from clear_strategies.data.photo_files import image_size, read_image
from clear_strategies.data.readers import colmap
from clear_strategies.data.strict_json import read_object
from clear_strategies.settings import build
from tests.helpers.captures import GOOD
from tests.stress.bad_inputs import BadInput, a_device, at, count, inputs, problem
from tests.stress.rows import Row

# Bad inputs that are attacks; the tables say what they hold.
_AMONG_THE_BAD = (
    "llff: npy of objects", "llff: pickle named .npy", "llff: npy header asks TiB", "llff: npy header nests",
    "SR model: network that is a pickle", "checkpoint: tensors are a pickle",
    "SR model: weights in a file above", "SR model: weights at an absolute path", "SR model: weights in /etc/passwd",
    "colmap: symlink leads out", "colmap: symlink in a circle", "colmap: txt absolute path", "colmap: txt path traversal",
    "nerfstudio: absolute file_path", "nerfstudio: PLY leads out", "blender: path leads out",
    "colmap: image bomb", "image: header of 2^31 pixels a side", "image: 100 megapixels of one colour",
    "colmap: count beyond file", "colmap: 2D count beyond file", "colmap: track beyond file",
    "PLY: count of 2^63", "PLY: count of 5,000 digits", "PLY: header of a mebibyte",
    "checkpoint: manifest nests 100,000 deep", "checkpoint: number of 5,000 digits",
    "checkpoint: tensors' header asks for 2^60 bytes", "blender: deep JSON", "blender: 5000 digits",
    "folder: metrics.json that nests 100,000 deep",
    "image: a pipe", "image: a device",
)  # fmt: skip
_TARGETS = (
    "pathlib.Path.write_text", "os.system", "subprocess.run", "builtins.exec", "builtins.eval", "torch.load",
    "torch.hub.load", "numpy.load", "pickle.loads", "runpy.run_path", "importlib.import_module", "shutil.rmtree",
    "clear_strategies.files.write_text", "clear_strategies.files.sweep", "clear_strategies.files.Path",
    "clear_strategies.data.ply.write_gaussians", "clear_strategies.training.checkpoint.Path.write_text",
    "torch.utils.cpp_extension.load", "clear_strategies.jobs.lock.hold", "rasterizers.native.importlib.import_module",
)  # fmt: skip
_REFUSED = r"^strategies.mine.*: .*(must name a class|is no class|cannot be imported)"


def _target(target: str, shape: Callable[[dict, str], object]) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        canary = str(folder / "canary")
        node = {"_target_": target, "path": canary, "data": "x", "self": canary, "command": f"touch {canary}"}
        return build(shape(node, canary), "strategies.mine")

    return give


_SHAPES: dict[str, Callable[[dict, str], object]] = {
    "called": lambda node, canary: node,
    "as a partial": lambda node, canary: {**node, "_partial_": True},
    "by its arguments": lambda node, canary: {"_target_": node["_target_"], "_args_": [canary]},
    "inside of a list": lambda node, canary: {"a": [node]},
}


def _linked_photo_of_another_ending(folder: Path) -> object:
    scene = GOOD["colmap"](folder / "scene")
    photo = scene / "images" / "b.png"
    photo.rename(folder / "secret.png")
    (scene / "images" / "b.jpg").symlink_to(folder / "secret.png")  # the model names b.png
    return colmap.read(scene)


def _model_in_a_pipe(folder: Path) -> object:
    scene = GOOD["colmap"](folder)
    (scene / "sparse/0/points3D.bin").unlink()
    os.mkfifo(scene / "sparse/0/points3D.bin")
    return colmap.read(scene)


_MORE = {
    "photo of another ending that leads out": (_linked_photo_of_another_ending, "leads out of"),
    "JSON that is a device": (at("endless", read_object, a_device), "is a pipe, a device or a socket"),
    "PLY that is a device": (at("endless", ply.read_points, a_device), "is a pipe, a device or a socket"),
    "size of an image that is a device": (at("endless", image_size, a_device), "is a pipe, a device or a socket"),
    "image that is a device": (at("endless", read_image, a_device), "is a pipe, a device or a socket"),
    "model in a pipe": (_model_in_a_pipe, "is a pipe, a device or a socket"),
}


def attacks() -> Iterator[BadInput]:
    """All of them."""
    by_id = {given.id: given for given in inputs()}
    yield from (replace(by_id[name], surface="attack", name=name) for name in _AMONG_THE_BAD)
    for name, (give, pattern) in _MORE.items():
        yield BadInput("attack", name, give, pattern)
    for target in _TARGETS:
        for how, shape in _SHAPES.items():
            yield BadInput("attack", f"_target_ {target} {how}", _target(target, shape), _REFUSED)


_EVENTS = {
    "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect", "socket.getaddrinfo",
}  # fmt: skip
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_SECRETS = ("secret", "/etc/passwd", "/etc/hostname")


class _Watch:
    """What the process does while an attack runs. Hooks cannot be removed, so there is one."""

    seen: list[str] | None = None
    folder = Path()
    installed = False

    @classmethod
    def hook(cls, event: str, arguments: tuple) -> None:
        if cls.seen is None:
            return
        if event in _EVENTS:
            cls.seen.append(event)
        elif event == "open" and isinstance(arguments[0], str | bytes):
            path, flags = os.fsdecode(arguments[0]), arguments[2]
            outside = not path.startswith(str(cls.folder)) and not path.endswith((".pyc", "/dev/null"))
            writes = isinstance(flags, int) and bool(flags & _WRITES) and ".pyc." not in path
            if (outside and writes) or (not writes and any(secret in path for secret in _SECRETS)):
                cls.seen.append(f"opened {path}")


@contextmanager
def watched(folder: Path) -> Iterator[list[str]]:
    """The traces that are left meanwhile."""
    if not _Watch.installed:
        sys.addaudithook(_Watch.hook)
        _Watch.installed = True
    _Watch.folder, _Watch.seen = folder, []
    try:
        yield _Watch.seen
    finally:
        _Watch.seen = None


def trace(given: BadInput, folder: Path) -> str | None:
    """What an attack brought about; None: it was refused, and nothing is left of it."""
    with watched(folder) as seen:
        wrong = problem(given, folder)
    canaries = [path for path in (*folder.rglob("canary"), Path("canary")) if path.exists()]
    return wrong or next(iter([*seen, *(f"{path} is there" for path in canaries)]), None)


def measure(folder: Path) -> Row:
    """How many attacks are not refused, or leave a trace."""
    return count(attacks(), trace, folder)["attack"].row("attacks: not refused, or a trace left", "all", 0, 40)
