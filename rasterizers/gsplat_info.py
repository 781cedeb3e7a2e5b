"""The `info` of gsplat's `rasterization`: what its strategies read of a picture, of all Gaussians or of the visible alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from typing import Any, cast

import torch
from jaxtyping import Int
from torch import Tensor

from rasterizers.differentiable import Drawing, stacked
from rasterizers.interface import RasterSettings, WithTraits
from rasterizers.modes import in_full_precision
from rasterizers.reference.projection import footprints


def info_of_all(each: Sequence[Drawing], lead: tuple[int, ...]) -> dict[str, Any]:
    """What gsplat's strategies read of these images.

    Args:
        lead: the dimensions of scenes and cameras, which `each` goes through.
    """
    renderings = [drawing.rendering for drawing in each]
    means2d = stacked([rendering.means2d for rendering in renderings])
    means2d = means2d.clone() if len(each) == 1 else means2d

    def radii() -> dict[str, Tensor]:
        found = stacked([cast(WithTraits, rendering).radii for rendering in renderings])
        return {"radii": found.view(*lead, *found.shape[1:])}

    def ellipses() -> dict[str, Tensor]:
        found: dict[str, list[Tensor]] = {name: [] for name in of_ellipses}
        for drawing in each:
            rows = drawing.rendering.visible.nonzero()[:, 0]
            columns = _columns(drawing, rows)
            for name, wholes in found.items():
                whole = columns[name].new_zeros(len(drawing.inputs.means), *columns[name].shape[1:])
                wholes.append(whole.index_copy(0, rows, columns[name]))
        return {name: torch.stack(x).view(*lead, *x[0].shape) for name, x in found.items()}

    own_radii = all(drawing.rasterizer.traits.radii for drawing in each)
    of_ellipses = ("depths", "conics", "opacities", *(() if own_radii else ("radii",)))
    later = {"radii": radii, **dict.fromkeys(of_ellipses, ellipses)}
    of_packed = dict.fromkeys(("gaussian_ids", "camera_ids", "batch_ids"))
    return _Info({"means2d": means2d.view(*lead, *means2d.shape[1:]), **of_packed}, later)


def info_of_visible(each: Sequence[Drawing], cameras: int, rows: Sequence[Int[Tensor, " _"]]) -> dict[str, Any]:
    """The same of the visible alone, which are these rows of each image."""
    columns = [_columns(*one) for one in zip(each, rows, strict=True)]
    info: dict[str, Any] = {name: torch.cat([x[name] for x in columns]) for name in columns[0]}
    view = torch.cat([torch.full_like(i, k) for k, i in enumerate(rows)])
    return info | {"gaussian_ids": torch.cat([*rows]), "camera_ids": view % cameras, "batch_ids": view // cameras}


@in_full_precision
def _columns(drawing: Drawing, rows: Int[Tensor, " M"]) -> dict[str, Tensor]:
    """The columns of gsplat's `info` for the visible Gaussians."""
    splats, settings = drawing.inputs, cast(RasterSettings, drawing.rasterizer)  # `over` has checked it
    f = footprints(splats.means[rows], splats.quats[rows], splats.scales[rows], drawing.camera, settings.kernel)
    opacities = splats.opacities[rows] * f.compensation if settings.antialiased else splats.opacities[rows]
    radii = f.radii(opacities, settings.alpha_min).int()
    means2d = drawing.rendering.means2d[rows]
    return {"means2d": means2d, "radii": radii, "depths": f.depths, "conics": f.conics, "opacities": opacities}


class _Info(dict[str, Any]):
    """Gsplat's `info`, a dictionary that computes some of its values when they are first read, also by an iteration over all.

    Args:
        values: known from the start.
        later: the function that computes each remaining value; it may return values of other names with it.
    """

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], dict[str, Any]]]) -> None:
        super().__init__(values)
        self._later = dict(later)

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or name in self._later

    def __missing__(self, name: str) -> Any:
        if name not in self._later:
            raise KeyError(name)
        for made, value in self._later[name]().items():
            super().setdefault(made, value)  # what the loop has written stays
            self._later.pop(made, None)
        return self[name]

    def __iter__(self) -> Iterator[str]:
        # Names make nothing: a type checker asks for one.
        return iter(dict.fromkeys((*super().__iter__(), *self._later)))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    pop, setdefault = MutableMapping.pop, MutableMapping.setdefault
    get, keys, values, items = Mapping.get, Mapping.keys, Mapping.values, Mapping.items  # type: ignore[assignment]

    def copy(self) -> dict[str, Any]:
        return dict(self)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self.copy(),)

    def __or__(self, other: dict[str, Any]) -> dict[str, Any]:  # type: ignore[override]
        return self.copy() | other
