"""From where the next photos would help most.

A photo shows a surface as far as it looks at it from the same side. Two photos give a surface its depth, so a further photo is
worth most where one photo shows what it shows; half as much where none does or two do, and nothing where `ENOUGH` do. It also
has to share half of what it shows with two photos, or its pose would not be sound. Background does not count.
`bench next_photo` measures what photos from there bring.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.geometry.cameras import moved
from clear_strategies.geometry.projection import back_project
from clear_strategies.geometry.visibility import sees
from clear_strategies.outputs.figures import spaced
from clear_strategies.viewing import paths
from clear_strategies.viewing.cameras import at_most
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera

ENOUGH: Final = 3
"""Photos that see a surface; more of them change little."""
_SIDE: Final = 4  # a photo from θ aside shows cos(θ) to this power of what a pixel shows: 78 % at 20°, 25 % at 45°
COMPARED: Final = 64
"""Photos that are asked what they see, at most."""

_RELATED: Final = 2
_OVERLAP: Final = (
    2 / 3
)  # of a next photo's pixels, those that `_RELATED` photos see: with less neither pose nor depth holds
_NEAREST: Final = 0.3  # of the depth at the photo it is moved from, its own depth: closer it stands before one thing
_LONGEST: Final = 0.5  # of that depth, the longest step
_BESIDE: Final = 16  # photos that a next one may stand beside, at most
_LONGER_SIDE: Final = 96  # px at which candidates are drawn

_MOVES: Final = {
    name: torch.tensor(direction, dtype=torch.float64)
    for name, direction in {
        "to the right of": (1, 0, 0), "to the left of": (-1, 0, 0), "above": (0, -1, 0), "below": (0, 1, 0),
    }.items()
}  # fmt: skip
_BETWEEN: Final = 4  # places on a path through the photos, for each of them
_STEPS: Final = (1, 2)

Seeing = tuple[Camera, Float[Tensor, "h w"]]
"""A camera and its depth."""


@dataclass(frozen=True, slots=True, eq=False)
class NextPhoto:
    """A camera from which a photo would help.

    Args:
        camera: as large as the photos.
        where: in words; a step is the usual distance of neighbouring photos.
        worth: of each pixel of a small picture, in [0, 1]; nan where there is no surface.
    """

    camera: Camera
    where: str
    worth: Float[Tensor, "h w"]

    @property
    def gain(self) -> float:
        """The mean of `worth`."""
        return float(self.worth.nanmean())


def with_depth(cameras: Sequence[Camera], painter: Painter) -> list[Seeing]:
    """Some of the cameras, at most `COMPARED`, small, with the depth of what they see."""
    small = [at_most(camera, _LONGER_SIDE) for camera in spaced(cameras, COMPARED)]
    return [(camera, painter.depth(camera)) for camera in small]


def next_photos(photos: Mapping[str, Camera], painter: Painter, count: int = 2) -> list[NextPhoto]:
    """The places where photos would help most, the best first; fewer than `count` where no other place helps.

    Each is chosen as if the photos before it had been taken.

    Args:
        photos: the cameras by the photos' names.
        painter: of the field that was trained on them.
    """
    candidates = list(_candidates(photos, painter))
    for camera, depth in with_depth(list(photos.values()), painter):
        for place in candidates:
            place.add(camera, depth)
    chosen: list[NextPhoto] = []
    while len(chosen) < count and candidates:
        least = min(_OVERLAP, max(place.overlap() for place in candidates))
        related = [place for place in candidates if place.overlap() >= least]
        worths = [1 - (place.shown.clamp(max=ENOUGH) - 1).abs() / (ENOUGH - 1) for place in related]
        best = max(range(len(related)), key=lambda i: float(worths[i].mean()))
        if float(worths[best].mean()) == 0:
            break
        place = related[best]
        chosen.append(NextPhoto(place.camera, place.where, place.picture(worths[best])))
        candidates.remove(place)
        for other in candidates:
            other.add(*place.seeing)
    return chosen


class _Candidate:
    """See `NextPhoto`.

    Args:
        seeing: the camera small, with the depth of what it sees, which is something.
    """

    def __init__(self, camera: Camera, where: str, seeing: Seeing) -> None:
        self.camera, self.where, self.seeing = camera, where, seeing
        small, depth = seeing
        self._rows, self._columns = torch.nonzero(depth.isfinite(), as_tuple=True)
        pixels = torch.stack((self._columns, self._rows), dim=1) + 0.5
        self._surface = back_project(small, pixels, depth[self._rows, self._columns])
        self._from_here = self._sight(small)
        self._seen = torch.zeros(len(self._surface), dtype=torch.long)
        self.shown = torch.zeros(len(self._surface))
        """How many photos show what each pixel shows, those from the same side as a whole."""

    def _sight(self, camera: Camera) -> Float[Tensor, "M 3"]:
        return torch.nn.functional.normalize(camera.center.float() - self._surface, dim=1)

    def add(self, camera: Camera, depth: Float[Tensor, "h w"]) -> None:
        """Count a photo."""
        seen = sees(camera, depth, self._surface)
        self._seen += seen
        self.shown += seen * (self._from_here * self._sight(camera)).sum(dim=1).clamp(min=0) ** _SIDE

    def overlap(self) -> float:
        """The share of what is seen from here that photos enough see, to relate a photo to them."""
        return float((self._seen >= _RELATED).float().mean())

    def picture(self, values: Float[Tensor, " M"]) -> Float[Tensor, "h w"]:
        """The values at their pixels; nan where no surface is."""
        found = torch.full(self.seeing[1].shape, torch.nan)
        found[self._rows, self._columns] = values
        return found


def _candidates(photos: Mapping[str, Camera], painter: Painter) -> Iterator[_Candidate]:
    """The places from which something is seen that is not right before the camera."""
    cameras = list(photos.values())
    centers = torch.stack([camera.center.double() for camera in cameras])
    apart = torch.cdist(centers, centers).fill_diagonal_(torch.inf)
    usual = float(apart.amin(dim=1).median())  # inf of a single photo
    places: list[tuple[str, Camera, float]] = []
    depths = []
    for name, camera in spaced(list(photos.items()), _BESIDE):
        depth = float(painter.depth(at_most(camera, _LONGER_SIDE)).nanmedian())
        if not depth > 0:  # nan: nothing is there
            continue
        depths.append(depth)
        step = min(usual, _LONGEST * depth)
        for (where, direction), times in itertools.product(_MOVES.items(), _STEPS):
            told = f"{times} step{'s' * (times > 1)} {where} {name}"
            places.append((told, moved(camera, times * step * direction, aim=depth), depth))
    if len(cameras) > 1 and depths:
        for camera in paths.through(cameras, _BETWEEN * min(len(cameras), _BESIDE)):
            distance = (centers - camera.center.double()).norm(dim=1)
            # The two photos between which it lies: the way from one to the other through it is hardly longer.
            detour = (distance[:, None] + distance - apart).fill_diagonal_(torch.inf)
            first, second = (list(photos)[i] for i in divmod(int(detour.argmin()), len(cameras)))
            places.append((f"between {first} and {second}", camera, min(depths)))
    for where, camera, depth in places:
        small = at_most(camera, _LONGER_SIDE)
        its_depth = painter.depth(small)
        if float(its_depth.nanmedian()) >= _NEAREST * depth:  # False where nothing is there
            yield _Candidate(camera, where, (small, its_depth))
