"""Every malformed scene is refused in one line that names the file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from clear_strategies.data.capture import Capture
from clear_strategies.data.readers import blender, colmap, llff, nerfstudio
from clear_strategies.errors import DataError
from tests.helpers.malformed import CASES, GOOD, Case

READERS: dict[str, Callable[[Path], Capture]] = {
    "colmap": colmap.read,
    "llff": llff.read,
    "blender": blender.read,
    "nerfstudio": nerfstudio.read,
}


@pytest.mark.parametrize("kind", GOOD)
def test_the_scenes_without_defect_are_valid(kind: str, tmp_path: Path) -> None:
    capture = READERS[kind.removesuffix("_txt")](GOOD[kind](tmp_path))
    assert [frame.load().shape for frame in capture.frames] == [(12, 16, 3)] * 3


@pytest.mark.parametrize("kind", GOOD)
def test_reading_poses_decodes_no_photo(kind: str, tmp_path: Path) -> None:
    """Truncated photos still have their headers: they are read, and refused when they are loaded."""
    root = GOOD[kind](tmp_path)
    for path in root.rglob("*.png"):
        path.write_bytes(path.read_bytes()[:-60])
    frames = READERS[kind.removesuffix("_txt")](root).frames
    assert len(frames) == 3
    for frame in frames:
        with pytest.raises(DataError, match="pixels: cannot be decoded"):
            frame.load()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_malformed_input_is_refused_in_one_line_that_names_the_file(case: Case, tmp_path: Path) -> None:
    kind, path = case.build(tmp_path)
    with pytest.raises(DataError) as refusal:
        _read_all(kind, path)
    message = str(refusal.value)
    assert "\n" not in message
    assert re.search(case.pattern, message), message
    assert message.startswith(str(path))
    assert all((refusal.value.field, refusal.value.problem, refusal.value.remedy))
    assert not (path / "canary").exists()


def test_names_of_cases_are_unique() -> None:
    assert len({case.name for case in CASES}) == len(CASES)


def _read_all(kind: str, path: Path) -> None:
    for frame in READERS[kind](path).frames:
        frame.load()
