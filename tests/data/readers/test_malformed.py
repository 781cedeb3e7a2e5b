"""The tiny scenes that tests/stress/bad_inputs spoils are sound, and their photos are decoded only when they are loaded."""

from __future__ import annotations

from pathlib import Path

import pytest

from clear_strategies.errors import DataError
from tests.helpers.captures import GOOD
from tests.stress.bad_inputs.scenes import READERS


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
