"""Captures with one defect: COLMAP, LLFF, Blender and nerfstudio files, and the photos that belong to them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from clear_strategies.data.capture import Capture
from clear_strategies.data.readers import blender, colmap, llff, nerfstudio
from tests.helpers.malformed import CASES, Case
from tests.stress.bad_inputs import BadInput

READERS: dict[str, Callable[[Path], Capture]] = {
    "colmap": colmap.read,
    "llff": llff.read,
    "blender": blender.read,
    "nerfstudio": nerfstudio.read,
}


def _read_all(case: Case) -> Callable[[Path], None]:
    def give(folder: Path) -> None:
        kind, path = case.build(folder)
        for frame in READERS[kind](path).frames:
            frame.load()

    return give


INPUTS = [BadInput(case.good.removesuffix("_txt"), case.name, _read_all(case), case.pattern) for case in CASES]
