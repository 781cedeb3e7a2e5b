"""Floor 4: where a finished run believed its prior, and where the photos overruled it, as maps over its training views.

Five numbers in [0, 1] for each pixel. Three are P2G's patches enlarged: `reliability` R, `demand` A, `weight` w = R·A. Two
are the Gaussians themselves, drawn over black with one number each as their grey: `corrected`, the share of its HR
gradient that a strategy took away, ‖g̃_HR - g_HR‖ / ‖g_HR‖ over all groups together, and `conflict`, 1 where g_LR and g_HR
point apart. Nothing of the run changes: copies of its strategies are asked.  Eq. 6, 7, 9, 11, 12
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, cast

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads, row_dot
from clear_strategies.core.images import DownKernel
from clear_strategies.core.view import View
from clear_strategies.data.photo_files import write_png
from clear_strategies.merging.conductor import Conductor
from clear_strategies.strategies.p2g import P2G, patch_evidence
from clear_strategies.training.field import FieldShot, GaussianField
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera, Rasterizer

_log = logging.getLogger(__name__)

MAPS: Final = ("reliability", "demand", "weight", "corrected", "conflict")
NOTE: Final = (
    "reliability, demand, weight: means over pixels; corrected, conflict: means over the Gaussians that the view moves "
    "at both scales"
)


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """One training view's maps.

    Args:
        maps: by the names in `MAPS`, at HR, in [0, 1]; "corrected" only where a strategy corrects.
        means: by the same names, over pixels for the patch maps and over Gaussians for the others.
    """

    maps: Mapping[str, Float[Tensor, "H W"]]
    means: Mapping[str, float]


def diagnose(
    field: GaussianField, conductor: Conductor, rasterizer: Rasterizer, view: View, *, down: DownKernel = "bicubic"
) -> Diagnosis:
    """All that can be said about one view, with every Gaussian taking part.

    Args:
        conductor: its objective and strategies make the gradients; a run without P2G gets P2G's default evidence.
        down: D of that default.
    """
    patches = _evidence_maps(conductor, view, down)
    lr, hr, corrected = _gradients(field, conductor, rasterizer, view)
    of_gaussians, compared = _compare(lr, hr, corrected)
    drawn = _draw(field, rasterizer, view.hr.camera, torch.stack(list(of_gaussians.values()), dim=1))
    maps = {**patches, **{name: drawn[..., k].clamp(0, 1) for k, name in enumerate(of_gaussians)}}
    means = {name: float(patch.mean()) for name, patch in patches.items()}
    means |= {name: float(values[compared].mean()) for name, values in of_gaussians.items()}
    return Diagnosis(maps, means)


def write_maps(
    folder: Path,
    views: Sequence[View],
    field: GaussianField,
    conductor: Conductor,
    rasterizer: Rasterizer,
    *,
    down: DownKernel = "bicubic",
) -> None:
    """Write maps.json and for each view a folder of 8-bit grey PNGs, value = 255 × number, beside the LR photo and the
    prior that they lie on.
    """
    means: dict[str, Mapping[str, float]] = {}
    for view in views:
        found = diagnose(field, conductor, rasterizer, view, down=down)
        means[view.name] = found.means
        own = folder / Path(view.name).stem
        for name, values in {**found.maps, "lr": view.lr.image, "prior": view.hr.image}.items():
            write_png(own / f"{name}.png", values)
    corrector = conductor.owner("correct")
    if corrector is None:
        _log.info("maps: no strategy corrects here; conflict.png shows what would be in conflict.")
    content = {
        "note": NOTE,
        "corrector": None if corrector is None else type(corrector).__name__,
        "evidence": "this run's P2G" if _own_p2g(conductor) is not None else "P2G's defaults",
        "views": means,
    }
    files.write_json(folder / "maps.json", content)


def _own_p2g(conductor: Conductor) -> P2G | None:
    return next((s for s in conductor.strategies if isinstance(s, P2G)), None)


def _evidence_maps(conductor: Conductor, view: View, down: DownKernel) -> dict[str, Tensor]:
    p2g = _own_p2g(conductor) or P2G(down=down)
    R, A = patch_evidence(
        view.lr.image, view.hr.image, view.factor, p2g.patch, p2g.reliability_scale, p2g.detail_eps, p2g.down, p2g.up
    )
    edge, camera = p2g.patch * view.factor, view.hr.camera

    def enlarged(patches: Tensor) -> Tensor:
        return images.upsample(patches[..., None], edge, "nearest")[: camera.height, : camera.width, 0]

    return {"reliability": enlarged(R), "demand": enlarged(A), "weight": enlarged(R * A)}


def _gradients(
    field: GaussianField, conductor: Conductor, rasterizer: Rasterizer, view: View
) -> tuple[Grads, Grads, Grads | None]:
    """g_LR, g_HR as routed, and g̃_HR where a strategy corrects; as `Conductor.update` makes them, before λ_HR."""
    objective = conductor.objective
    aside = Conductor(*copy.deepcopy(conductor.strategies), objective=objective)
    lr, hr = (cast(FieldShot, shot) for shot in field.render_scales(rasterizer, view))  # both scales are asked for
    (g_lr,) = lr.vjp(objective.lr(lr.image.detach(), view.lr.image).cotangents)
    g_hr, *rest = hr.vjp(objective.hr(hr.image.detach(), view.hr.image).cotangents)
    observer, router, corrector = map(aside.owner, ("observe", "route", "correct"))
    e = None if observer is None else observer.observe(view, hr)
    for g_hf in rest:
        m = 1.0 if router is None else router.route(e)
        g_hr = g_hr + g_hf * m * objective.lambda_hf
    g_lr, g_hr = (Grads({name: g[name] for name in CONFLICT_GROUPS if name in g}) for g in (g_lr, g_hr))
    return g_lr, g_hr, None if corrector is None else corrector.correct(g_lr, g_hr, e)


def _compare(lr: Grads, hr: Grads, corrected: Grads | None) -> tuple[dict[str, Tensor], Tensor]:
    """Numbers [N] by map, and which Gaussians could be compared: the others are 0."""
    dot, lr2, hr2 = _inner(lr, hr), _inner(lr, lr), _inner(hr, hr)
    compared = (lr2 > 0) & (hr2 > 0)
    numbers = {}
    if corrected is not None:
        step = corrected + hr * -1.0
        share = (_inner(step, step) / hr2.clamp_min(torch.finfo(hr2.dtype).tiny)).sqrt()
        numbers["corrected"] = torch.where(compared, share.clamp(0, 1), 0.0)
    numbers["conflict"] = ((dot < 0) & compared).to(dot)
    return numbers, compared


def _inner(a: Grads, b: Grads) -> Float[Tensor, " N"]:
    """⟨a_i, b_i⟩ over the concatenated groups."""
    return torch.stack([row_dot(a[name], b[name]) for name in a]).sum(0)


def _draw(
    field: GaussianField, rasterizer: Rasterizer, camera: Camera, numbers: Float[Tensor, "N K"]
) -> Float[Tensor, "H W 3"]:
    """The Gaussians with their K <= 3 numbers as colour, over black whatever the rasterizer's background is."""
    splats = field.fused()

    def drawn(rgb: Tensor) -> Tensor:
        sh0 = ((rgb - 0.5) / SH_C0)[:, None]
        return rasterizer(replace(splats, sh0=sh0, shN=splats.shN[:, :0], rgb_offset=None), camera).image

    rgb = splats.means.new_zeros(len(splats), 3)
    rgb[:, : numbers.shape[1]] = numbers.to(rgb)
    return drawn(rgb) - drawn(torch.zeros_like(rgb))
