"""Random numbers that are functions of (seed, t): a checkpoint needs no generator, and a resumed run draws the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

T = TypeVar("T")


def generator_at(seed: int, t: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A new generator, a different one for every t < 1,000,003 of every seed.

    Two purposes with the same (seed, t) get the same random bits. A purpose that must be independent of the others takes
    `hashed_generator_at`.
    """
    return torch.Generator(device).manual_seed((seed * 1_000_003 + t) % 2**63)


def hashed_generator_at(seed: int, t: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A new generator, unrelated to those of neighbouring t and of `generator_at`: (seed, t) is hashed to 63 bits."""
    x = (seed * 0x9E3779B97F4A7C15 + t * 0xBF58476D1CE4E5B9) & (2**64 - 1)
    x = (x ^ (x >> 31)) * 0x94D049BB133111EB & (2**64 - 1)
    return torch.Generator(device).manual_seed((x ^ (x >> 29)) >> 1)


def one_of(items: Sequence[T], generator: torch.Generator) -> T:
    """One of the items, all equally likely."""
    return items[int(torch.randint(len(items), (), generator=generator, device=generator.device))]


def dropout_mask(n: int, p: float, seed: int, t: int, device: torch.device | str = "cpu") -> Float[Tensor, " N"]:
    """Bernoulli(1 - p) / (1 - p) for n Gaussians, drawn on `device` and reproducible there from (seed, t).  Eq. 15"""
    generator = hashed_generator_at(seed, t, device)
    return (torch.rand(n, generator=generator, device=device) >= p) / (1 - p)  # Eq. 15
