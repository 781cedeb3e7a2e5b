"""mistakes.csv: each command of it ends with the message and the exit code that stand there."""

import csv
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.helpers import captures, command_line
from tests.stress.bad_inputs import bomb

TABLE = Path(__file__).with_name("mistakes.csv")
OF_POSES = ("apart", "flat", "same")  # folders whose photos are matched first, which takes seconds
with TABLE.open(newline="") as file:
    ROWS = [
        {key: text.replace("apart", other) for key, text in row.items()}
        for row in csv.DictReader(file)
        for other in (("apart", "flat") if "train apart" in row["command"] else ("apart",))
    ]


def noise(seed: int) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, (240, 320, 3), dtype=np.uint8))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the commands of the table name."""
    here = tmp_path_factory.mktemp("mistakes")
    photos = {
        "empty": [], "one": [noise(0)], "two": [noise(0), noise(1)], "same": [noise(0)] * 4,
        "apart": [noise(i) for i in range(4)],
        "flat": [Image.new("RGB", (320, 240), (60 * i, 90, 90)) for i in range(4)],
        "huge": [noise(0), noise(1)],
    }  # fmt: skip
    for name, images in photos.items():
        (here / name).mkdir()
        for i, image in enumerate(images):
            image.save(here / name / f"{i}.png")
    captures.write_photos(captures.colmap_bin(here / "hidden") / "masks")
    for mask in (here / "hidden/masks").iterdir():
        Image.new("L", (captures.WIDTH, captures.HEIGHT)).save(mask)
    captures.write_photos(captures.colmap_bin(here / "misfit") / "masks", (captures.HEIGHT, captures.WIDTH))
    captures.write_photos(captures.colmap_bin(here / "thumbnails") / "images", (9, 6))
    (here / "text").mkdir()
    for i in range(3):
        (here / "text" / f"{i}.jpg").write_text("no photo")
    (here / "huge/2.png").write_bytes(bomb(30_000, 20_000))
    (here / "file").write_text("no folder")
    for file in ("clip.mp4", "photos.zip", "raws/IMG_1.CR2", "rig/cam1/0.jpg", "rig/cam2/0.jpg"):
        (here / file).parent.mkdir(exist_ok=True, parents=True)
        (here / file).write_text("no folder")
    (here / "damaged.ply").write_text("ply\nformat ascii 1.0\n")
    (here / "compressed.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty uint packed_position\nend_header\n"
    )
    captures.demo_on_disk(here / "turned", scale=0.0)
    (captures.nerfstudio(here / "renamed") / "images").rename(here / "renamed/photos")
    halves, panorama = {"fl_x": 0.9, "fl_y": 1.2, "cx": 0.5, "cy": 0.5}, {"camera_model": "EQUIRECTANGULAR"}
    for name, lens in (("units", halves), ("panoramas", panorama)):
        captures.edit(captures.nerfstudio(here / name) / "transforms.json", lambda value, lens=lens: value.update(lens))
    for file, text in (("polycam/keyframes/cameras/1.json", '{"t_00": 1}'), ("record3d/metadata", '{"poses": []}')):
        (here / file).parent.mkdir(parents=True)
        (here / file).write_text(text)
    return here


def marks(command: str) -> list[pytest.MarkDecorator]:
    no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
    return [pytest.mark.slow] * (not {*OF_POSES}.isdisjoint(command.split())) + [no_gpu] * ("cuda" in command)


@pytest.mark.parametrize("row", [pytest.param(row, id=row["command"], marks=marks(row["command"])) for row in ROWS])
def test_a_mistake_is_told_with_its_remedy(row: dict[str, str], folder: Path) -> None:
    before = {path for path in folder.iterdir() if path.name not in ("outputs", "cache")}
    ended = command_line.run(*shlex.split(row["command"]), cwd=folder)
    assert ended.returncode == int(row["code"]), ended.stdout + ended.stderr
    told = list(filter(None, (ended.stdout + ended.stderr).splitlines()))
    # The last but one on a slow machine, the last before a run, and "clear-strategies" before one of photos.
    progress = (
        r".*: estimating the poses|features of |matching |placing |SR |.*: \d+ of \d+ |clear-strategies \+"
        r"|  (data|strategies|iterations)  "
    )
    error = [line for line in told if not re.match(progress, line)]
    assert 1 <= len(error) <= 3, told
    assert row["message"] in " ".join(error)
    assert "Traceback" not in ended.stderr
    assert {path for path in folder.iterdir() if path.name not in ("outputs", "cache")} == before
    assert not list(folder.rglob("metrics.json"))
    assert not list(folder.rglob("*.tmp"))


PYTHON = """
from clear_strategies import GCO, SVS, Conductor
from clear_strategies.errors import SettingError
for call in "Conductor('gco')", "Conductor([GCO()])", "Conductor(GCO)", "SVS(dropout=0.2)":
    try:
        eval(call)
    except SettingError as error:
        print(error)
"""


def test_from_python_what_is_of_another_type_is_refused_where_it_is_given(tmp_path: Path) -> None:
    said = command_line.run(cwd=tmp_path, code=PYTHON).stdout  # a process without the tests' type checker
    assert said.count("takes strategies one by one") == 3
    assert "dropout: must be a Ramp, got 0.2: dropout=Ramp(0.2)" in said
