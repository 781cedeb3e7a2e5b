"""The bounds within which a backend agrees with float64. tests/rasterizers/test_agreement.py shows that each can fail."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

INTERIOR = 5e-6  # the error of image values without flips
INTERIOR_SHARE = 0.9998  # the share of values without flips
FLIP = 8e-3  # the error of a value where rounding flips a cut-off


def require_image(found: Tensor, exact: Tensor) -> None:
    """Nearly all values agree to rounding; the others, where a cut-off flips, are bounded."""
    error = (found.double() - exact.double()).abs()
    inside = float((error <= INTERIOR).double().mean())
    assert inside >= INTERIOR_SHARE, f"only {inside:.5%} of the values agree to {INTERIOR:g}"
    assert float(error.max()) <= FLIP, f"a value is off by {float(error.max()):.2g}"


def require_gradient(name: str, found: Tensor, exact: Tensor, *, relative: float = 5e-5) -> None:
    """Gradients agree over all Gaussians and one by one: norm, direction, bias, and none is missing."""
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
