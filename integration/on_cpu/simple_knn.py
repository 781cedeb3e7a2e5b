"""`simple_knn._C.distCUDA2`, from whose distances 3DGS and its forks choose the first scales, as it is in 3DGS and in FSGS."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_K = 3


def distances_and_indices(points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, " N"], Int[Tensor, "N 3"]]:
    """The mean squared distance to the three nearest other points, and as FSGS has them, their indices.

    Raises:
        ValueError: there are fewer than four points.
    """
    from scipy.spatial import cKDTree  # only trainers that ask for it need it

    if len(points) <= _K:
        raise ValueError(f"at least {_K + 1} points are needed to start from, got {len(points)}.")
    rows = points.detach().double().numpy()
    distances, indices = map(torch.as_tensor, cKDTree(rows).query(rows, k=_K + 1, workers=-1))
    return distances[:, 1:].square().mean(1).to(points.dtype), indices[:, 1:].int()
