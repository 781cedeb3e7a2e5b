"""What it means that a backend agrees with float64: the bounds, each of them able to fail (test_agreement)."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

INTERIOR = 5e-6  # of image values, for all but …
INTERIOR_SHARE = 0.9998
FLIP = 8e-3  # … pixels where a Gaussian crossed a threshold one way here and the other way in float64


def require_image(found: Tensor, exact: Tensor) -> None:
    """Interior values agree to rounding; the few others are flips of a threshold, bounded and of both signs."""
    error = (found.double() - exact.double()).abs()
    inside = float((error <= INTERIOR).double().mean())
    assert inside >= INTERIOR_SHARE, f"only {inside:.5%} of the values agree to {INTERIOR:g}"
    assert float(error.max()) <= FLIP, f"a value is off by {float(error.max()):.2g}"


def require_gradient(name: str, found: Tensor, exact: Tensor, *, relative: float = 5e-5) -> None:
    """Over all Gaussians and one by one: norm, direction, bias, and no gradient missing."""
    a, b = (x.double().reshape(len(x), -1) for x in (found, exact))
    assert bool(a.isfinite().all()), f"{name}: not finite"
    size = torch.linalg.vector_norm(b)
    off = float(torch.linalg.vector_norm(a - b) / size)
    assert off <= relative, f"{name}: relative error {off:.2g}"
    cosine = float((a * b).sum() / (torch.linalg.vector_norm(a) * size))
    assert cosine >= 1 - 1e-8, f"{name}: cosine 1 - {1 - cosine:.2g}"
    bias = float(((a - b) * b.sign()).sum() / b.abs().sum())
    assert abs(bias) <= 1e-5, f"{name}: biased by {bias:.2g}"
    rows = torch.linalg.vector_norm(b, dim=1)
    large = rows >= rows[rows > 0].median() / 100
    each = torch.linalg.vector_norm(a - b, dim=1)[large] / rows[large]
    assert float((each <= 1e-3).double().mean()) >= 0.99, f"{name}: many Gaussians are off by more than 1e-3"
    missing = (torch.linalg.vector_norm(a, dim=1) == 0) & large
    assert not bool(missing.any()), f"{name}: {int(missing.sum())} Gaussians have lost their gradient"


def require_same_bits(found: Iterable[Tensor], expected: Iterable[Tensor]) -> None:
    for a, b in zip(found, expected, strict=True):
        assert torch.equal(a, b)
