"""Folders where a data set, a run or its lock should be, and is not, or is something else."""

import json
from collections.abc import Callable
from pathlib import Path

from clear_strategies.data.photo_folders import image_folder, list_images
from clear_strategies.data.readers import colmap
from clear_strategies.files import hold
from clear_strategies.jobs import resume
from clear_strategies.jobs.saved import open_splat
from tests.helpers.captures import GOOD, READERS
from tests.helpers.short_run import SCENE
from tests.stress.bad_inputs import BadInput, at


def _held_twice(folder: Path) -> None:
    with hold(folder), hold(folder):
        pass


def _photos_gone(folder: Path) -> None:
    GOOD["colmap"](folder)
    for photo in (folder / "images").iterdir():
        photo.unlink()


def _finished(metrics: object) -> Callable[[Path], object]:
    content = metrics if isinstance(metrics, str) else json.dumps(metrics)
    return at("metrics.json", lambda path: resume.finished(path.parent, {}, lambda: SCENE), content.encode())


def _hidden_photos_only(folder: Path) -> None:
    (folder / ".a.png").write_bytes(b"")
    (folder / "notes.txt").write_text("")


_CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    **{f"{kind} at a path that is absent": (at("none", read), "none") for kind, read in READERS.items()},
    **{f"{kind} at a path that is a file": (at("file", read, b"no folder"), "file") for kind, read in READERS.items()},
    **{f"{kind} in an empty folder": (read, ": ") for kind, read in READERS.items()},
    "no photo of the model is there": (
        at("", colmap.read, _photos_gone),
        "none of 3 is in .*images, such as a.png; it holds nothing",
    ),
    "no folder of photos": (image_folder, "images: has none of the folders images, images_2"),
    "folder of photos by a name that is not there": (lambda folder: image_folder(folder, "images_16"), "is no folder"),
    "photos at a path that is absent": (at("none", list_images), "folder: is not there"),
    "photos at a path that is a file": (at("file", list_images, b"no folder"), "folder: is a file"),
    "folder without images": (at("", list_images, _hidden_photos_only), "images: holds no image"),
    "lock held by this process": (_held_twice, "is at work in this folder"),
    "run that is absent": (at("none", open_splat), "none"),
    "run that is an empty folder": (open_splat, ": "),
    "run that is a text": (at("file", open_splat, b"no folder"), "file"),
    "metrics.json that is empty": (_finished(""), "metrics.json: "),
    "metrics.json that is a list": (_finished([]), "metrics.json: "),
    "metrics.json without scores": (_finished({"config": {}}), "metrics.json: "),
    "metrics.json whose config is a list": (_finished({"config": []}), "metrics.json: "),
    "metrics.json that nests 100,000 deep": (_finished("[" * 100_000), "metrics.json: "),
}
INPUTS = [BadInput("folder", name, give, pattern) for name, (give, pattern) in _CASES.items()]
