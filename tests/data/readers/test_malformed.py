"""The tiny scenes that tests/stress/bad_inputs spoils are sound: what every reader makes of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clear_strategies.errors import DataError
from tests.helpers import captures as tiny
from tests.helpers.captures import GOOD
from tests.stress.bad_inputs.scenes import READERS


@pytest.mark.parametrize("kind", GOOD)
def test_cameras_are_opencv_at_the_size_of_the_photos(kind: str, tmp_path: Path) -> None:
    frames = READERS[kind.removesuffix("_txt")](GOOD[kind](tmp_path)).frames
    assert len(frames) == 3
    for i, frame in enumerate(frames):
        camera = frame.camera
        np.testing.assert_allclose(camera.world_to_camera.numpy(), tiny.world_to_camera(i), atol=1e-12)
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        assert intrinsics == pytest.approx((20, 20, 8, 6, 16, 12))


@pytest.mark.parametrize("kind", GOOD)
def test_reading_poses_decodes_no_photo(kind: str, tmp_path: Path) -> None:
    """Truncated photos still have their headers: they are read, and refused when they are loaded."""
    root = GOOD[kind](tmp_path)
    for path in root.rglob("*.png"):
        path.write_bytes(path.read_bytes()[:-60])
    for frame in READERS[kind.removesuffix("_txt")](root).frames:
        with pytest.raises(DataError, match="pixels: cannot be decoded"):
            frame.load()
