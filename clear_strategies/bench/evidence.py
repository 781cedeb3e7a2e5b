"""Does reliability find wrong detail? ROC-AUC of P2G's R against the known mask of a prior with seeded errors.

AUC is the share of pairs of a right and a wrong patch in which the right one has the higher R: 1 finds all of them, 0.5 is
chance. The errors are asked about twice: as the prior makes them, which disagree with the LR photo to some extent, and hidden,
so that the LR photo cannot tell (`SeededErrors.hidden`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, Final

import pandas as pd
import torch
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from clear_strategies.bench.results import Results
from clear_strategies.compose import composed, tree
from clear_strategies.core.view import Photo, View
from clear_strategies.data.priors.corrupted import SeededErrors
from clear_strategies.errors import SettingError
from clear_strategies.jobs.scene import load
from clear_strategies.jobs.settings import settings_of
from clear_strategies.strategies.p2g import P2G

_DEMO: Final = ("prior=demo",)


def measure(results: Results, *, overrides: Sequence[str] = ()) -> None:
    """Fill `results` with a row for each kind of error, and a picture of the first view's R.

    Raises:
        SettingError, DataError: the overrides, or the data, cannot be used; or the prior has no seeded errors.
    """
    chosen = list(overrides) or list(_DEMO)
    errors = _errors(tree(composed(chosen, "config"))["prior"])
    settings = settings_of(tree(composed([*chosen, "prior.share=0", "data.views.test_limit=0"], "config")))
    patch = P2G().patch * settings.data.views.sr_scale
    if errors.patch != patch:
        raise SettingError(
            f"prior.patch: must be P2G's patch of {patch} HR px, got {errors.patch}. Set prior.patch={patch}."
        )
    scene = load(settings.data, settings.prior, settings.fit.seed)
    p2g, rows = P2G(down=settings.data.views.downsample), []
    for kind, wanted in (("seeded", replace(errors, hidden=False)), ("hidden", replace(errors, hidden=True))):
        views = [_with_errors(view, wanted) for view in scene.train]
        maps = [p2g.patch_maps(view).reliability for view in views]
        masks = [wanted.wrong(v.hr.camera.height, v.hr.camera.width, v.factor, v.name) for v in views]
        R, wrong = (torch.cat([x.flatten() for x in of_views]) for of_views in (maps, masks))
        found = {"auc": auc(R[~wrong], R[wrong]), "R right": R[~wrong].mean().item(), "R wrong": R[wrong].mean().item()}
        rows.append({"scene": scene.name, "errors": kind, **found, "patches": float(len(R))})
        results.figures[f"evidence_{kind}"] = _picture(views[0], maps[0], masks[0], errors.patch)
    results.tables["evidence"] = pd.DataFrame(rows)
    results.note(
        f"{scene.name}, {len(scene.train)} training views, errors in {errors.share:.0%} of the patches of {errors.patch} HR px."
    )


def auc(right: Float[Tensor, " K"], wrong: Float[Tensor, " M"]) -> float:
    """The share of pairs in which `right` is larger; ties count half. nan without pairs."""
    if not len(right) or not len(wrong):
        return float("nan")
    larger, equal = right[:, None] > wrong, right[:, None] == wrong
    return (larger.double() + 0.5 * equal.double()).mean().item()


def _errors(prior: Mapping[str, Any]) -> SeededErrors:
    """The errors of a prior's node; a SettingError where it makes none."""
    names = [f.name for f in fields(SeededErrors)]
    if not all(name in prior for name in names):
        raise SettingError(
            f"prior: must have seeded errors, whose mask is known, got {prior.get('_target_')}. Add prior=corrupted "
            "prior.prior.path=FILE.onnx, or prior=demo for a scene whose photos are HR."
        )
    return SeededErrors(**{name: prior[name] for name in names})


def _with_errors(view: View, errors: SeededErrors) -> View:
    image = errors.corrupt(view.hr.image, view.lr.image, view.factor, view.name)
    return replace(view, hr=Photo(view.hr.camera, image))


def _picture(view: View, R: Float[Tensor, "ph pw"], wrong: Bool[Tensor, "ph pw"], patch: int) -> Figure:
    """The SR image and R of it, with the wrong patches framed."""
    height, width = view.hr.image.shape[:2]
    figure = Figure(figsize=(6, 3 * height / width + 0.4), layout="constrained")
    image, of_patches = axes = figure.subplots(1, 2)
    image.imshow(view.hr.image.cpu().numpy(), interpolation="nearest")
    image.set_title("SR image, wrong patches framed", fontsize=9)
    extent = (0, R.shape[1] * patch, R.shape[0] * patch, 0)
    of_patches.imshow(R.cpu().numpy(), vmin=0, vmax=1, cmap="gray", extent=extent, interpolation="nearest")
    of_patches.set(xlim=(0, width), ylim=(height, 0))
    of_patches.set_title("R", fontsize=9)
    for axis in axes:
        axis.axis("off")
        for row, column in torch.nonzero(wrong).tolist():
            box = (column * patch + 2, row * patch + 2)
            axis.add_patch(Rectangle(box, patch - 4, patch - 4, fill=False, edgecolor="tab:red", linewidth=1.2))
    return figure
