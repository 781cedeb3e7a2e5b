"""NeRF-synthetic ("Blender") scenes: transforms_train.json and transforms_test.json, RGBA images over white."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from clear_strategies.data import strict_json
from clear_strategies.data.cameras import Lens, by_name, make_frame, pose_from_opengl
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.photo_files import image_size, inside
from clear_strategies.errors import DataError

_WHITE: Final = (1.0, 1.0, 1.0)


def read(root: str | Path) -> Capture:
    """A scene folder; frames are named by their file (r_2), test frames get "test/" before it.

    Raises:
        DataError: something is missing or not what it should be.
    """
    root = Path(root)
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    train = _frames(root, root / "transforms_train.json", "train")
    test = _frames(root, root / "transforms_test.json", "test")
    # The order of the file is the protocol's numbering; by_name only guards against two frames of one name.
    by_name([*train, *test], root)
    notes = {"poses": "transforms_train.json, transforms_test.json", "background": "white under the images' alpha"}
    return Capture(root.resolve().name, (*train, *test), None, _WHITE, notes)


def _frames(root: Path, file: Path, split: str) -> list[Frame]:
    content = strict_json.read_object(file)
    angle = strict_json.number(file, "camera_angle_x", content.get("camera_angle_x"))
    if not 0 < angle < math.pi:
        raise DataError(file, "camera_angle_x", f"is {angle:g}; it must lie in (0, pi) radians", "correct the field")
    frames = []
    for i, frame in enumerate(strict_json.frames_of(file, content)):
        name = strict_json.file_path(file, i, frame)
        path = inside(root, name if Path(name).suffix else f"{name}.png", file=file)
        pose = pose_from_opengl(file, f"frames[{i}].transform_matrix", frame.get("transform_matrix"))
        width, height = image_size(path)
        focal = width / (2 * math.tan(angle / 2))
        lens = Lens(width, height, focal, focal, width / 2, height / 2).check(file, "camera_angle_x")
        label = path.stem if split == "train" else f"{split}/{path.stem}"
        frames.append(make_frame(label, path, lens, pose, background=_WHITE, split=split))
    return frames
