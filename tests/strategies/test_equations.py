"""A whole iteration of CLEAR as printed, against its equations in numpy loops, float64, one Gaussian after another."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from clear_strategies import CONFLICT_GROUPS
from clear_strategies.compose import conductor
from clear_strategies.core import images
from clear_strategies.training.loop import iterate, view_at
from tests.helpers import toy

END = 40
"""λ_HR rises from iteration 2 to 12 and falls from 20 on, where the anchor is taken."""


def resized(image, width, height):
    """By PIL, bicubic; of uint8 in 8 bits, of float in float."""
    layers = [
        Image.fromarray(np.ascontiguousarray(layer)).resize((width, height), Image.Resampling.BICUBIC)
        for layer in image
    ]
    return np.stack([np.asarray(layer, dtype=np.float64) for layer in layers])


def patches(lr, hr):
    """Eq. 9, of images [3, H, W]: τ_r = 0.05, patches of 16 and 64 pixels."""
    h, w = lr.shape[1:]
    reduced = resized(np.rint(255 * hr).astype(np.uint8), w, h) / 255
    detail = np.abs(hr - resized(reduced.astype(np.float32), 4 * w, 4 * h).clip(0, 1))
    R, A = np.zeros((2, -(-h // 16), -(-w // 16)))
    for i, j in np.ndindex(R.shape):
        at = [(slice(None), slice(s * i, s * i + s), slice(s * j, s * j + s)) for s in (16, 64)]
        R[i, j] = np.exp(-np.abs(reduced - lr)[at[0]].mean() / 0.05)
        A[i, j] = min(1, detail[at[1]].mean() / (2 * detail.mean() + 1e-4))
    return R, A


def corrected(l, h, q):
    """Eq. 6, 7 and 11: τ_c = 0.05, ω in [0.05, 0.75]."""
    l_norm, h_norm = np.linalg.norm(l), np.linalg.norm(h)
    if l_norm * h_norm == 0 or (c := l @ h / (l_norm * h_norm)) >= -0.05:
        return h
    omega = min(0.75, max(0.05, (-c - 0.05) / 0.95 * (1 - q)))
    return h - omega * (l @ h + 0.05 * l_norm * h_norm) / l_norm**2 * l


def photometric(x, y):
    """Eq. 4 and L_base of Eq. 5, of images [3, H, W]."""
    g = torch.exp(-((torch.arange(11.0, dtype=torch.float64) - 5) ** 2) / 4.5)
    window = (torch.outer(g, g) / g.sum() ** 2).expand(3, 1, 11, 11)
    x_, y_, xx, yy, xy = (F.conv2d(z[None], window, padding=5, groups=3) for z in (x, y, x * x, y * y, x * y))
    s = (2 * x_ * y_ + 1e-4) * (2 * (xy - x_ * y_) + 9e-4) / ((x_**2 + y_**2 + 1e-4) * (xx - x_**2 + yy - y_**2 + 9e-4))
    return 0.8 * (x - y).abs().mean() + 0.2 * (1 - s.mean())


def haar(x, y):
    """L_HF of Eq. 5: one level."""
    d = x - y
    a, b, c, e = d[:, ::2, ::2], d[:, ::2, 1::2], d[:, 1::2, ::2], d[:, 1::2, 1::2]
    return torch.stack((a - b + c - e, a + b - c - e, a - b - c + e)).abs().mean() / 2


def gradient(loss, shot, target):
    x = shot.image.detach().double().permute(2, 0, 1).requires_grad_()
    loss(x, target.double().permute(2, 0, 1)).backward()
    return shot.vjp(x.grad.permute(1, 2, 0)[None].float())[0]


@pytest.mark.parametrize("fused", ["off", "auto"])
@pytest.mark.parametrize(("t", "lambda_hr"), [(9, 0.7), (16, 1.0), (30, 0.55)])
def test_a_step_is_that_of_the_equations(fused, t, lambda_hr):
    scene, clear = toy.scene(), conductor("clear_paper", iterations=END)

    def spoiled(view):  # so that LR and HR disagree in half of the image
        image = view.hr.image.clone()
        image[:, :48] = images.quantize(1 - image[:, :48])
        return replace(view, hr=replace(view.hr, image=image))

    scene = replace(scene, train=tuple(map(spoiled, scene.train)))
    s = toy.started(
        *clear.strategies, objective=clear.objective, of=scene, fused=fused, iterations=END, degree_every=5, near=0.01
    )
    svs = clear.strategies[2]
    while s.t < t:
        iterate(s, toy.RASTERIZER)
    view, theta, n = view_at(s), {k: p.double().numpy().copy() for k, p in s.field.raw().items()}, len(s.field)
    z = svs.gate(t, n)
    assert z.unique().tolist() == pytest.approx([0, 1 / (1 - 0.2 * t / END)])  # Eq. 15
    lr, hr = s.field.render_scales(toy.RASTERIZER, view, gate=z)
    l, base, hf = (
        gradient(photometric, lr, view.lr.image),
        gradient(photometric, hr, view.hr.image),
        gradient(haar, hr, view.hr.image),
    )
    l, base, hf = ({k: g.double().numpy() for k, g in grads.items()} for grads in (l, base, hf))
    R, A = patches(*(photo.image.double().numpy().transpose(2, 0, 1) for photo in (view.lr, view.hr)))
    expected, moments = (
        {k: np.zeros_like(g) for k, g in base.items()},
        {k: m.double().numpy().copy() for k, m in s.optimizer.first.items()},
    )
    opposed, weights = [], []
    for i in range(n):
        x, y = hr.means2d[i].tolist()
        at = min(max(int(y // 64), 0), R.shape[0] - 1), min(max(int(x // 64), 0), R.shape[1] - 1)
        q, a = (R[at], A[at]) if hr.visible[i] else (0, 0)  # Eq. 10
        m = 0.25 + 0.75 * q * a  # Eq. 12
        g_hr = {k: base[k][i] + 0.2 * m * hf[k][i] for k in CONFLICT_GROUPS}  # Eq. 13
        for k in CONFLICT_GROUPS:
            g = corrected(l[k][i].ravel(), g_hr[k].ravel(), q)
            expected[k][i] = l[k][i] + lambda_hr * g.reshape(l[k][i].shape)  # Eq. 8
        expected["detail"][i] = lambda_hr * 0.2 * m * hf["detail"][i]
        whole = [np.concatenate([g[k].ravel() for k in CONFLICT_GROUPS]) for g in ({k: l[k][i] for k in l}, g_hr)]
        if all(g.any() for g in whole):
            opposed.append(whole[0] @ whole[1] < 0)
        weights.append(q * a)
    assert bool(svs.state) == (t >= 20)
    for k, anchor in svs.state.items():  # Eq. 16; positions in units of the anchor's extent
        W = {"means": 1 / svs.cache["extent"][1] ** 2, "opacities": 0.1, "sh0": 0.01, "shN": 0.01}.get(k, 1.0)
        expected[k] += 2 * 0.01 * W * (theta[k] - anchor.double().numpy())
    iterate(s, toy.RASTERIZER)
    assert 0.1 < np.mean(opposed) < 0.9
    assert float(s.history_as_floats()[-1]["conflict"]) == pytest.approx(np.mean(opposed))
    assert max(weights) > 0.1
    for k, g in expected.items():
        got = (s.optimizer.first[k].double().numpy() - 0.9 * moments[k]) / 0.1
        width = slice(0, g.shape[1] if k == "shN" else None)
        assert np.abs(got[:, width] - g if k == "shN" else got - g).max() < 2e-5 * np.abs(g).max() + 1e-9, k
