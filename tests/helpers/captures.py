"""Tiny valid scenes on disk: three views of 16x12 px in every format.

The readers' tests compare with the cameras here. The malformed inputs are these scenes with one defect each.
"""

import json
import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from clear_strategies.core.view import Photo
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.readers import blender as read_blender
from clear_strategies.data.readers import colmap, demo
from clear_strategies.data.readers import nerfstudio as read_nerfstudio
from clear_strategies.data.view_settings import ViewSettings
from rasterizers import Camera
from tests.helpers.image_files import exif_orientation

WIDTH, HEIGHT = 16, 12
FOCAL = 20.0
NAMES = ("a.png", "b.png", "c.png")
# Turned about y by 0, 10 and 20 degrees: (w, x, y, z) of COLMAP's world-to-camera rotations.
QUATERNIONS = tuple((math.cos(math.radians(a) / 2), 0.0, math.sin(math.radians(a) / 2), 0.0) for a in (0, 10, 20))
TRANSLATIONS = ((0.0, 0.0, 1.0), (0.1, 0.0, 1.0), (0.2, -0.1, 1.5))
POINTS = ((0.0, 0.0, 3.0), (0.5, -0.25, 4.0))
COLORS = ((255, 0, 51), (0, 102, 255))
TRACKS = ((1, 2), (2, 3))  # image ids; 0-based 2D indices are all 0
MODEL_NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FOV": 7}


def world_to_camera(view: int) -> np.ndarray:
    """The pose of a view, by the textbook formula for a turn about y."""
    angle = math.radians(10 * view)
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    pose[:3, 3] = TRANSLATIONS[view]
    return pose


def require_poses(capture: Capture) -> None:
    """The cameras of a capture are those here."""
    assert len(capture.frames) == len(NAMES)
    for i, frame in enumerate(capture.frames):
        camera = frame.camera
        np.testing.assert_allclose(camera.world_to_camera.numpy(), world_to_camera(i), atol=1e-12)
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        np.testing.assert_allclose(intrinsics, (FOCAL, FOCAL, 8, 6, WIDTH, HEIGHT))


def opengl(view: int) -> list[list[float]]:
    """Camera-to-world with x right, y up, z back."""
    return (np.linalg.inv(world_to_camera(view)) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def in_a_row(*sizes: tuple[int, int], image: torch.Tensor | None = None) -> Capture:
    """Photos of these sizes, (width, height), from places side by side; gradients, unless an image is given."""
    frames = []
    for i, (width, height) in enumerate(sizes):
        pose = torch.eye(4)
        pose[0, 3] = -i
        camera = Camera(pose, 1.2 * width, 1.2 * width, 0.45 * width, 0.55 * height, width, height)
        shown = (
            torch.linspace(0, 1, width)[None, :, None].expand(height, width, 3).contiguous() if image is None else image
        )
        photo = Photo(camera, shown)
        frames.append(Frame(f"{i:04d}.png", camera, lambda photo=photo: photo))
    return Capture("made up", tuple(frames))


POINTS_AT_RANDOM = CloudSettings(init="random", random_points=50)
"""Initial points of photos that show nothing."""


def papers(**settings: Any) -> ViewSettings:
    """The papers' protocols: conf/protocol/_papers.yaml."""
    return ViewSettings(**{"train": 3, "test_every": 8, "photos_are": "hr", **settings})


def alike(n: int = 3, width: int = 16, height: int = 16, image: torch.Tensor | None = None) -> Capture:
    """Photos of one size, in a row."""
    return in_a_row(*[(width, height)] * n, image=image)


def write_photos(folder: Path, size: tuple[int, int] = (WIDTH, HEIGHT), mode: str = "RGB") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(NAMES):
        pixels = np.random.default_rng(i).integers(0, 256, (size[1], size[0], len(mode)), np.uint8)
        Image.fromarray(pixels).save(folder / name)


def turn(path: Path, *, rotate: bool = True) -> np.ndarray:
    """Store a photo turned, as its EXIF block then says; its upright pixels. Without `rotate` the block alone changes."""
    with Image.open(path) as image:
        upright = image.convert("RGB")
    stored = Image.Transpose.ROTATE_90  # for EXIF's 6
    (upright.transpose(stored) if rotate else upright).save(path, exif=exif_orientation(6))
    return np.array(upright)


def colmap_bin(root: Path, model: str = "PINHOLE", parameters: tuple[float, ...] = (FOCAL, FOCAL, 8, 6)) -> Path:
    """images/ and sparse/0 in COLMAP's binary layout."""
    write_photos(root / "images")
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    camera = struct.pack("<QiiQQ", 1, 1, MODEL_NUMBERS[model], WIDTH, HEIGHT)
    (sparse / "cameras.bin").write_bytes(camera + struct.pack(f"<{len(parameters)}d", *parameters))
    images = struct.pack("<Q", len(NAMES))
    for i, name in enumerate(NAMES):
        images += struct.pack("<i7di", i + 1, *QUATERNIONS[i], *TRANSLATIONS[i], 1) + name.encode() + b"\0"
        images += struct.pack("<Qddq", 1, 8.0, 6.0, -1)
    (sparse / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(POINTS))
    for i, (xyz, rgb, track) in enumerate(zip(POINTS, COLORS, TRACKS, strict=True)):
        points += struct.pack("<Q3d3BdQ", i + 1, *xyz, *rgb, 0.5, len(track))
        points += b"".join(struct.pack("<ii", image, 0) for image in track)
    (sparse / "points3D.bin").write_bytes(points)
    return root


def images_txt(names: Sequence[str] = NAMES, points: str | None = None, header: str = "") -> str:
    """The poses of photos, each with a line of 2D points."""
    rows = [" ".join(map(str, (i + 1, *QUATERNIONS[i], *TRANSLATIONS[i], 1, name))) for i, name in enumerate(names)]
    lines = [points] * len(rows) if points is not None else ["\n", *["8.0 6.0 -1\n"] * (len(rows) - 1)]
    return header + "".join(f"{row}\n{line}" for row, line in zip(rows, lines, strict=True))


def colmap_txt(root: Path, listed: Callable[[str], str] = str) -> Path:
    """The same scene in COLMAP's text layout, with photos by the names that `listed` makes of theirs."""
    write_photos(root / "images")
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    cameras = f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 8 6\n"
    (sparse / "cameras.txt").write_text(cameras)
    header = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    (sparse / "images.txt").write_text(images_txt([listed(name) for name in NAMES], header=header))
    points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    for i, (xyz, rgb, track) in enumerate(zip(POINTS, COLORS, TRACKS, strict=True)):
        points += " ".join(map(str, (i + 1, *xyz, *rgb, 0.5))) + "".join(f" {image} 0" for image in track) + "\n"
    (sparse / "points3D.txt").write_text(points)
    return root


def llff(root: Path) -> Path:
    """The same scene in LLFF's layout: reduced photos under other names, in the order of the model's."""
    colmap_bin(root)
    (root / "images").rename(root / "images_4")
    (root / "poses_bounds.npy").touch()
    return root


def blender(root: Path, listed: Callable[[str], str] = lambda name: f"./{name[:-4]}") -> Path:
    """Two training views and a test view, RGBA."""
    write_photos(root / "train", mode="RGBA")
    angle = 2 * math.atan(WIDTH / (2 * FOCAL))
    for split, views in (("train", (0, 1)), ("test", (2,))):
        frames = [{"file_path": listed(f"train/{NAMES[i]}"), "transform_matrix": opengl(i)} for i in views]
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
    return root


def nerfstudio(root: Path, listed: Callable[[str], str] = str) -> Path:
    """images/ and transforms.json with shared intrinsics and no distortion."""
    write_photos(root / "images")
    frames = [{"file_path": listed(f"images/{name}"), "transform_matrix": opengl(i)} for i, name in enumerate(NAMES)]
    shared = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 8.0, "cy": 6.0, "w": WIDTH, "h": HEIGHT, "camera_model": "OPENCV"}
    write_json(root / "transforms.json", {**shared, "frames": frames})
    return root


def demo_on_disk(root: Path, scale: float = 1.0, views: int = 4, size: tuple[int, int] = (64, 48)) -> Path:
    """Views of the demo's room as a nerfstudio capture, in other units: `scale` units to one of the room's."""
    frames = []
    for i, frame in enumerate(views_of := demo.read(width=size[0], height=size[1], views=views, train=2).frames):
        write_png(root / f"images/{i}.png", frame.load().image)
        matrix = np.linalg.inv(frame.camera.world_to_camera.double().numpy()) @ np.diag([1.0, -1, -1, 1])
        matrix[:3, 3] *= scale
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": matrix.tolist()})
    camera = views_of[0].camera
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": size[0], "h": size[1]}
    write_json(root / "transforms.json", {**lens, "frames": frames})
    return root


def edit(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a JSON file's object in place."""
    value = json.loads(file.read_text())
    change(value)
    write_json(file, value)


GOOD: dict[str, Callable[..., Path]] = {
    "colmap": colmap_bin, "colmap_txt": colmap_txt, "blender": blender, "nerfstudio": nerfstudio,
}  # fmt: skip
"""What writes each of them."""
READERS: dict[str, Callable[..., Capture]] = {
    "colmap": colmap.read, "colmap_txt": colmap.read, "blender": read_blender.read, "nerfstudio": read_nerfstudio.read,
}  # fmt: skip
"""What reads them."""


def write_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value, indent=1))
