"""Single Gaussians over the whole range of scales, depths, opacities and quaternion norms, against float64."""

import itertools
import math
from collections.abc import Iterator, Mapping

import torch

from rasterizers import Camera, Rasterizer, Splats
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import gradient_of
from tests.helpers.backends import CLEAN
from tests.stress.rows import Row, Worst

SCALES = [10.0**k for k in range(-8, 9)]
DEPTHS = [10.0**k for k in range(-6, 7)]
LOGITS = (-100.0, -15.0, -5.0, 0.0, 5.0, 15.0, 100.0)
NORMS = [10.0**k for k in (-20, -15, -10, -5, 0, 5, 10, 15, 20)]
NAMES = ("means", "quats", "scales", "opacities", "sh0")
_IMAGE, _GRADIENT = 1e-4, 1e-3

# The rotation does not matter for a ball, so the axes differ. The direction is off the camera's axis.
_SHAPE = torch.tensor([[1.0, 0.7, 0.4]])
_QUATERNION = torch.tensor([[0.8, -0.3, 0.5, 0.2]])
_CAMERA = Camera(torch.eye(4), 12.0, 12.0, 4.2, 4.7, 9, 9)


def cases(every: int = 1) -> Iterator[tuple[str, Splats]]:
    """All 13,923 or every n-th."""
    table = itertools.product(SCALES, DEPTHS, LOGITS, NORMS)
    for scale, depth, logit, norm in itertools.islice(table, 0, None, every):
        opacity = torch.sigmoid(torch.tensor([logit]))
        yield (
            f"scale {scale:g}, depth {depth:g}, logit {logit:g}, norm {norm:g}",
            Splats(
                means=torch.tensor([[0.05, -0.03, 1.0]]) * depth, quats=_QUATERNION * norm, scales=_SHAPE * scale,
                opacities=opacity, sh0=torch.tensor([[[0.9, 0.2, -0.5]]]), shN=torch.zeros(1, 0, 3),
            ),
        )  # fmt: skip


def measure(backends: Mapping[str, Rasterizer], *, every: int = 1) -> Iterator[Row]:
    """The image and the gradients of every case, by each backend.

    The rotation's gradient is measured against the quaternion's own scale: ‖g_quat‖ · ‖q‖, which does not depend on ‖q‖.
    """
    exact = ReferenceRasterizer(**CLEAN)
    v = torch.randn(1, 9, 9, 3, generator=torch.Generator().manual_seed(0))
    images, gradients = ({name: Worst() for name in backends} for _ in range(2))
    for where, splats in cases(every):
        reference = exact(splats.to(torch.float64), _CAMERA)
        expected = reference.vjp(v.double()) if bool(reference.visible.any()) else None
        for name, draw in backends.items():
            rendering = draw(splats, _CAMERA)
            images[name].add(float((rendering.image.double() - reference.image).abs().max()), where)
            if expected is not None:
                gradients[name].add(_gradient_error(rendering.vjp(v), expected, splats), where)
    for name in backends:
        yield images[name].row("single Gaussians: image", name, _IMAGE)
        yield gradients[name].row("single Gaussians: gradient", name, _GRADIENT)


def _gradient_error(gradients, expected, splats: Splats) -> float:
    """The largest relative error over the attributes, each in units that its own scale removes: g · parameter."""
    units = {"means": splats.means, "quats": splats.quats, "scales": splats.scales, "opacities": splats.opacities}
    errors, sizes = [], []
    for name in NAMES:
        unit = units.get(name, torch.ones(1)).double().abs().amax()
        a, b = gradient_of(gradients, name).double() * unit, gradient_of(expected, name) * unit
        errors.append(float(torch.linalg.vector_norm(a - b)))
        sizes.append(float(torch.linalg.vector_norm(b)))
    scale = max(sizes)
    if scale == 0:
        return max(errors)
    return max(errors) / scale if all(map(math.isfinite, errors)) else math.inf
