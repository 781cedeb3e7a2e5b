"""Depth where it is unknown: smooth surfaces through what is known, which end at the edges of the photo.

On a plane, inverse depth is linear in the pixels: its second differences are 0 there, and large where a surface ends, which is
mostly where colours change. The completed inverse depth u minimises, with d what is known of it,

    Σ c ρ(u − d)  +  Σ e |∂xx u|, |∂yy u|, |∂xy u|  +  3·10⁻³ Σ e (∂x u)², (∂y u)²,      e = exp(−|colour difference| / 0.025)

where ρ (Geman and McClure 1985) ignores outliers and the last term keeps planes from being continued far.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_EDGE: Final = 0.025  # difference of colours, of 1, at which an edge of the photo weakens the smoothness e-fold
_LEVEL: Final = 3e-3  # weight of the first differences
_BEND: Final = 0.01  # second difference from which it counts by its size in place of its square; in medians of d
_OUTLIER: Final = 0.05  # distance from d at which ρ' begins to fall; in medians of d
_HELD: Final = 1e-9  # weight of the median of d, where nothing else decides
_ROUNDS: Final = 6  # of reweighted least squares


def completed(
    known: Float[Tensor, "h w"], confidence: Float[Tensor, "h w"], image: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w"]:
    """Inverse depth at every pixel, float64; it may be 0 or less far from all that is known.

    Args:
        known: inverse depth > 0, NaN where unknown; known somewhere.
        confidence: c ≥ 0 of what is known.
        image: the photo, in [0, 1].
    """
    import scipy.sparse as sp
    from scipy.sparse.linalg import splu

    def difference(n: int) -> Any:
        identity = sp.eye(n, format="csr")
        return identity[1:] - identity[:-1]

    (h, w), colors = known.shape, image.double().cpu().numpy()
    d = known.double().cpu().numpy().ravel()
    is_known = np.isfinite(d)
    scale = np.median(d[is_known])
    d = np.where(is_known, d / scale, 0.0)
    c = np.where(is_known, confidence.double().cpu().numpy().ravel(), 0.0)
    across, down = (np.exp(-np.abs(np.diff(colors, axis=axis)).mean(-1) / _EDGE) for axis in (1, 0))
    dx, dy = sp.kron(sp.eye(h), difference(w)), sp.kron(difference(h), sp.eye(w))
    dxx, dyy = sp.kron(sp.eye(h), difference(w - 1)) @ dx, sp.kron(difference(h - 1), sp.eye(w)) @ dy
    dxy = sp.kron(difference(h), difference(w))
    bends = (
        (dxx, np.minimum(across[:, 1:], across[:, :-1]).ravel()),
        (dyy, np.minimum(down[1:], down[:-1]).ravel()),
        (dxy, np.minimum(np.minimum(across[1:], across[:-1]), np.minimum(down[:, 1:], down[:, :-1])).ravel()),
    )
    level = sum(_LEVEL * D.T @ sp.diags(e.ravel()) @ D for D, e in ((dx, across), (dy, down)))
    level += _HELD * sp.eye(h * w)
    missed, bent = np.zeros(h * w), [np.zeros(D.shape[0]) for D, _ in bends]
    for _ in range(_ROUNDS):
        trust = c / (1 + (missed / _OUTLIER) ** 2) ** 2
        H = sp.diags(trust) + level
        for (D, e), bend in zip(bends, bent, strict=True):
            H += D.T @ sp.diags(e / np.hypot(bend / _BEND, 1)) @ D
        solver = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        u = solver.solve(trust * d + _HELD)
        missed, bent = u - d, [D @ u for D, _ in bends]
    return torch.from_numpy((scale * u).reshape(h, w))
