"""Which depths stand alone: a few pixels beside which no depth is like theirs are mostly chance matches."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.geometry.libraries import missing


def speckles(depth: Float[Tensor, "h w"], fewest: int, tolerance: float) -> Bool[Tensor, "h w"]:
    """Where known depth belongs to fewer than `fewest` connected pixels; nowhere without SciPy.

    Two pixels are connected if they share an edge, and their depths differ by at most `tolerance`, relatively.

    Args:
        depth: NaN where unknown.
    """
    if fewest <= 1 or missing("scipy"):
        return torch.zeros_like(depth, dtype=torch.bool)
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    values = depth.double().cpu().numpy()
    pixel = np.arange(values.size).reshape(values.shape)
    edges = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        alike = np.abs(values[here] / values[there] - 1) <= tolerance  # False beside NaN
        edges.append((pixel[here][alike], pixel[there][alike]))
    rows, columns = (np.concatenate(ends) for ends in zip(*edges, strict=True))
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(values.size, values.size))
    _, island = connected_components(graph, directed=False)
    small = (np.bincount(island)[island] < fewest).reshape(values.shape)
    return (torch.from_numpy(small) & depth.cpu().isfinite()).to(depth.device)
