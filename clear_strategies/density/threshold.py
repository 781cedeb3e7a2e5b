"""Selection of Gaussians by a score of any scale: as many as the ordinary statistic selects (F9)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def count_passing(statistic: Float[Tensor, " N"], threshold: float) -> int:
    """The number of Gaussians whose statistic reaches the threshold."""
    return int((statistic >= threshold).sum())


def topk_mask(score: Float[Tensor, " N"], k: int) -> Bool[Tensor, " N"]:
    """The mask of the k highest scores, the first of equal ones; scores of 0 are never selected."""
    order = torch.argsort(score, descending=True, stable=True)[:k]
    selected = torch.zeros_like(score, dtype=torch.bool)
    selected[order] = score[order] > 0
    return selected


def topk_threshold(score: Float[Tensor, " N"], k: int) -> float:
    """A threshold that the k highest scores exceed (fewer if scores are equal); scores of 0 never do."""
    if k == 0:
        return math.inf
    best = score.double().topk(min(k + 1, len(score))).values
    following = float(best[k]) if k < len(score) else 0.0
    return (float(best[k - 1]) + following) / 2
