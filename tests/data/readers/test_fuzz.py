"""Random damage to the files of a scene: a sound capture or a DataError, never anything else, in bounded memory."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from clear_strategies.data.readers import colmap, llff, nerfstudio
from clear_strategies.errors import DataError
from tests.helpers.malformed import GOOD

READERS = {"colmap": colmap.read, "colmap_txt": colmap.read, "llff": llff.read, "nerfstudio": nerfstudio.read}
FUZZED = [
    ("colmap", "sparse/0/cameras.bin"),
    ("colmap", "sparse/0/images.bin"),
    ("colmap", "sparse/0/points3D.bin"),
    ("colmap_txt", "sparse/0/images.txt"),
    ("llff", "poses_bounds.npy"),
    ("nerfstudio", "transforms.json"),
    ("colmap", "images/b.png"),
]


@pytest.fixture
def bounded_memory() -> Iterator[None]:
    """Limit the memory, so that a reader that allocates by a damaged count fails here."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**30, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize(("kind", "name"), FUZZED, ids=lambda value: Path(value).name)
def test_random_damage_gives_a_sound_capture_or_a_data_error(
    kind: str, name: str, tmp_path: Path, bounded_memory: None
) -> None:
    """430 mutants a file, 3,010 in all: flipped, overwritten, repeated, removed and cut bytes."""
    file = GOOD[kind](tmp_path) / name
    good, rng = file.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(430):
        file.write_bytes(_mutant(good, rng))
        try:
            capture = READERS[kind](tmp_path)
            image = capture.frames[1].load() if name.endswith(".png") else None
        except DataError:
            refused += 1
            continue
        assert image is None or (image.shape == (12, 16, 3) and image.isfinite().all())
        for frame in capture.frames:
            rotation = frame.camera.world_to_camera[:3, :3]
            assert (rotation @ rotation.T - rotation.new_ones(3).diag()).abs().max() < 1e-6
        if capture.points is not None:
            assert capture.points.means.isfinite().all()
            assert set(capture.points.track_image.tolist()) <= {frame.sfm_id for frame in capture.frames}
    assert refused > 50


def _mutant(good: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(good)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(data))) if data else 0
        length = int(rng.integers(1, 9))
        match rng.integers(5):
            case 0 if data:
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                data[at : at + length] = rng.choice([0, 0x7F, 0x80, 0xFF]).astype(np.uint8).tobytes() * length
            case 2:
                data[at:at] = data[at : at + length]
            case 3:
                del data[at : at + length]
            case _:
                if rng.integers(4) == 0:
                    del data[at:]
    return bytes(data)
