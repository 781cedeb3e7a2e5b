"""What a reader hands over: posed photos at their own size, and the points a structure-from-motion found.

Readers know files; they know nothing of splits, scales, priors or training. `scene.py` makes a `Scene` of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from jaxtyping import Float, Int
from torch import Tensor

from rasterizers.interface import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One posed photo.

    Args:
        name: unique in its capture, e.g. the file's name.
        camera: pinhole (already undistorted), on the pixel grid of the image that `load` returns.
        load: reads the image, float32 [H, W, 3] in [0, 1]; called when needed, so unused views cost nothing.
        split: "train" or "test" where the data set itself says so (Blender), else None.
        sfm_id: the id by which `SfmPoints.seen_by` speaks of this frame, or None.
    """

    name: str
    camera: Camera
    load: Callable[[], Float[Tensor, "H W 3"]]
    split: str | None = None
    sfm_id: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SfmPoints:
    """Triangulated points with their tracks, flattened: frame `seen_by[j]` saw point number `point[j]`."""

    means: Float[Tensor, "N 3"]
    colors: Float[Tensor, "N 3"]
    point: Int[Tensor, " M"]
    seen_by: Int[Tensor, " M"]
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A set of posed photos, sorted by name, and what is known of the scene's structure.

    Args:
        background: what lies behind (white for Blender's RGBA), RGB in [0, 1].
        notes: label -> fact for the printed plan (where poses came from, what was undistorted …).
    """

    name: str
    frames: tuple[Frame, ...]
    points: SfmPoints | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: dict[str, str] = field(default_factory=dict)
