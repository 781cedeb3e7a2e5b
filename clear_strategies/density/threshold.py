"""Which Gaussians a score picks: as many as the ordinary statistic would, whatever the scale of the score (F9)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def count_passing(statistic: Float[Tensor, " N"], threshold: float) -> int:
    """How many Gaussians the ordinary statistic passes."""
    return int((statistic >= threshold).sum())


def topk_mask(score: Float[Tensor, " N"], k: int) -> Bool[Tensor, " N"]:
    """The k highest scores, the first of equal ones; scores of 0 are never picked."""
    order = torch.argsort(score, descending=True, stable=True)[:k]
    picked = torch.zeros_like(score, dtype=torch.bool)
    picked[order] = score[order] > 0
    return picked


def topk_threshold(score: Float[Tensor, " N"], k: int) -> float:
    """A threshold that the k highest scores exceed (fewer where scores are equal); scores of 0 never do."""
    if k == 0:
        return math.inf
    best = score.double().topk(min(k + 1, len(score))).values
    following = float(best[k]) if k < len(score) else 0.0
    return (float(best[k - 1]) + following) / 2
