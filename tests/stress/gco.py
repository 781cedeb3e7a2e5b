"""GCO's correction against mpmath, over the range of float32."""

import mpmath
import torch

from clear_strategies import GCO, Grads
from tests.stress.rows import Row, Worst

DIMENSIONS = (1, 3, 4, 15, 45)
_ERROR = 1.2e-7


def vectors(n: int, d: int, exponent: float, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.randn(n, d, generator=g, dtype=torch.float64) * 10.0**exponent


def right(l_row: list[float], h_row: list[float], tau: float, low: float, high: float) -> list[float]:
    """Eq. 6, 7 and 11 without ε, with 60 digits."""
    with mpmath.workdps(60):
        l, h = [mpmath.mpf(x) for x in l_row], [mpmath.mpf(x) for x in h_row]
        dot = mpmath.fsum(a * b for a, b in zip(l, h, strict=True))
        n_l, n_h = (mpmath.sqrt(mpmath.fsum(x * x for x in v)) for v in (l, h))
        if n_l == 0 or n_h == 0 or dot / (n_l * n_h) >= -tau:
            return h_row
        c = dot / (n_l * n_h)
        omega = min(max((-c - tau) / (1 - tau), low), high)
        step = omega * (dot + tau * n_l * n_h) / n_l**2
        return [float(b - step * a) for a, b in zip(l, h, strict=True)]


def measure(rows: int = 200) -> list[Row]:
    """Random rows of every dimension, with norms from 1e-36 to 1e36."""
    rule, worst, missed = GCO(keep_length=False), Worst(), Worst()
    for d in DIMENSIONS:
        for exponent in range(-36, 37, 6):
            l = vectors(rows, d, exponent, seed=d).float()
            h = vectors(rows, d, -exponent / 2, seed=d + 1).float()
            group = "shN" if d > 4 else "means"
            shape = (rows, d // 3, 3) if d % 3 == 0 and group == "shN" else (rows, d)
            found = rule.correct(Grads({group: l.view(shape)}), Grads({group: h.view(shape)}), None)[group].view(
                rows, d
            )
            for i in range(0, rows, max(1, rows // 10)):
                expected = torch.tensor(right(l[i].tolist(), h[i].tolist(), 0.05, 0.05, 0.75), dtype=torch.float64)
                size = float(h[i].double().norm())
                error = float((found[i].double() - expected).norm()) / size
                worst.add(error, f"D={d}, norms 1e{exponent} and 1e{-exponent / 2:g}, row {i}")
    for spread in (0.0, 1e30):
        l, h = vectors(rows, 3, -5, seed=1).float(), vectors(rows, 3, -5, seed=2).float()
        h[: rows // 2] = -l[: rows // 2]
        if spread:
            l[0], h[0] = spread, spread
        found = rule.correct(Grads({"means": l}), Grads({"means": h}), None)["means"]
        conflicts = (l.double() * h.double()).sum(1) < 0
        clear = conflicts & (torch.nn.functional.cosine_similarity(l.double(), h.double()) < -0.06)
        unmoved = (found == h).all(1) & clear
        missed.add(float(unmoved.sum()), "one row of 1e30 among rows of 1e-5" if spread else "rows of 1e-5")
    return [
        worst.row("GCO: error of the corrected gradient over its norm", "readable", _ERROR),
        missed.row("GCO: conflicts that an outlier hides", "readable", 0),
    ]
