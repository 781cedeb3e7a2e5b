"""What EXIF blocks say of a photo's lens and exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from clear_strategies.data.photo_files import exif_of

_EXPOSURE_TIME: Final = 0x829A  # s
_F_NUMBER: Final = 0x829D
_ISO: Final = 0x8827
_FOCAL_35MM: Final = 0xA405
_DIAGONAL_35MM: Final = math.hypot(36, 24)  # mm


@dataclass(frozen=True, slots=True)
class Exif:
    """Of one photo; None where its block does not say.

    Args:
        focal35: focal length on 35 mm film of the same diagonal, mm.
        exposure: how much light the photo took of the same scene, in stops (powers of two), from an arbitrary zero.
    """

    focal35: float | None = None
    exposure: float | None = None

    def focal_pixels(self, width: int, height: int) -> float | None:
        """The focal length of an image of this size, pixels."""
        return None if self.focal35 is None else self.focal35 / _DIAGONAL_35MM * math.hypot(width, height)


def read_exif(path: Path) -> Exif:
    """The block of a photo; a DataError if the file is no readable image."""
    tags = exif_of(path)
    time, f_number, iso = (_positive(tags.get(tag)) for tag in (_EXPOSURE_TIME, _F_NUMBER, _ISO))
    exposure = None
    if time is not None and f_number is not None:
        exposure = math.log2(time * (iso or 100) / f_number**2)
    return Exif(_positive(tags.get(_FOCAL_35MM)), exposure)


def _positive(value: Any) -> float | None:
    """A finite number above 0; cameras also write 0, 0/0, text and tuples."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    return number if math.isfinite(number) and number > 0 else None
