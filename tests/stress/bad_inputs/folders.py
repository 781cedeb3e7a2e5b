"""Folders where a data set, a run or its lock should be, and is not, or is something else."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from pathlib import Path

from clear_strategies.data.photo_files import image_folder, inside, list_images
from clear_strategies.data.readers import blender, colmap, llff, nerfstudio
from clear_strategies.jobs import resume
from clear_strategies.jobs.lock import NAME, hold
from clear_strategies.jobs.saved import open_splat
from tests.helpers.malformed import GOOD
from tests.stress.bad_inputs import BadInput

_READERS = {"COLMAP": colmap.read, "LLFF": llff.read, "Blender": blender.read, "nerfstudio": nerfstudio.read}


def _absent(read: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda folder: read(folder / "none")


def _a_file(read: Callable[[Path], object]) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        (folder / "file").write_text("no folder")
        return read(folder / "file")

    return give


def _made(make: Callable[[Path], object], read: Callable[[Path], object]) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        make(folder)
        return read(folder)

    return give


def _held(text: str) -> Callable[[Path], object]:
    def give(folder: Path) -> None:
        (folder / NAME).write_text(text)
        with hold(folder):
            pass

    return give


def _taken(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def give(folder: Path) -> None:
        make(folder / NAME)
        with hold(folder):
            pass

    return give


def _held_twice(folder: Path) -> None:
    with hold(folder), hold(folder):
        pass


def _photos_renamed(folder: Path) -> None:
    GOOD["colmap"](folder)
    (folder / "images").rename(folder / "photos")


def _photos_gone(folder: Path) -> None:
    GOOD["colmap"](folder)
    for photo in (folder / "images").iterdir():
        photo.unlink()


def _finished(content: object) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        (folder / "metrics.json").write_text(content if isinstance(content, str) else json.dumps(content))
        return resume.finished(folder, {})

    return give


def _hidden_photos_only(folder: Path) -> None:
    (folder / ".a.png").write_bytes(b"")
    (folder / "notes.txt").write_text("")


_ELSEWHERE = {"host": socket.gethostname() + "-another", "pid": 1, "started": "1", "since": "2026-01-01"}
_CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    **{f"{name} at a path that is absent": (_absent(read), "none") for name, read in _READERS.items()},
    **{f"{name} at a path that is a file": (_a_file(read), "file") for name, read in _READERS.items()},
    **{f"{name} in an empty folder": (read, ": ") for name, read in _READERS.items()},
    "photos in a folder of another name": (_made(_photos_renamed, colmap.read), "images: is no folder|has none of"),
    "no photo of the model is there": (_made(_photos_gone, colmap.read), "is not in .*, and no other photo is"),
    "no folder of photos": (image_folder, "images: has none of the folders images, images_2"),
    "folder of photos by a name that is not there": (lambda folder: image_folder(folder, "images_16"), "is no folder"),
    "photos at a path that is absent": (_absent(list_images), "folder: is not there"),
    "folder without images": (_made(_hidden_photos_only, list_images), "images: holds no image"),
    "name of a photo that is empty": (lambda folder: inside(folder, "", file=folder), "'' is no file name"),
    "name of a photo with a zero": (lambda folder: inside(folder, "a\0.png", file=folder), "is no file name"),
    "name of a photo with 300 letters": (lambda folder: inside(folder, "x" * 300, file=folder), "is no file name"),
    "name of a photo with 200 accents": (lambda folder: inside(folder, "é" * 200, file=folder), "is no file name"),
    "lock held by this process": (_held_twice, "is at work in this folder"),
    "lock held on another host": (_held(json.dumps(_ELSEWHERE)), "cannot be known from"),
    "lock that is no JSON": (_held("{"), "cannot be known from"),
    "lock that is a list": (_held("[]"), "cannot be known from"),
    "lock that is a folder": (_taken(Path.mkdir), "lock: is a link or no regular file"),
    "lock that is a pipe": (_taken(os.mkfifo), "lock: is a link or no regular file"),
    "lock that is a link": (
        _taken(lambda path: path.symlink_to(path.with_name("canary"))),
        "lock: is a link or no regular file",
    ),
    "run that is absent": (_absent(open_splat), "none"),
    "run that is an empty folder": (open_splat, ": "),
    "run that is a text": (_a_file(open_splat), "file"),
    "metrics.json that is empty": (_finished(""), "metrics.json: "),
    "metrics.json that is a list": (_finished([]), "metrics.json: "),
    "metrics.json without scores": (_finished({"config": {}}), "metrics.json: "),
    "metrics.json whose config is a list": (_finished({"config": []}), "metrics.json: "),
    "metrics.json that nests 100,000 deep": (_finished("[" * 100_000), "metrics.json: "),
}
INPUTS = [BadInput("folder", name, give, pattern) for name, (give, pattern) in _CASES.items()]
