"""Single Gaussians over the whole range of scales, depths, opacities and quaternion norms, and needles, against float64."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping

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
LENGTHS = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)  # px, standard deviation; the width is 0.3 px
AWAY = (0.0, 0.3, 1.0, 2.0)  # standard deviations from the centre to the image
ANGLES = [math.pi * k / 24 for k in range(24)]
ASIDE = (0.0, 0.4, -0.9)  # px from the axis to the middle of the image
_IMAGE, _GRADIENT = 1e-5, 1e-4
_OF_NEEDLES = 2e-4, 1e-2  # 2,000 px from the centre, where float32 resolves 1e-4 px

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


def needles(every: int = 1) -> Iterator[tuple[str, Splats]]:
    """All 1,728 needles parallel to the image at depth 1, or every n-th."""
    pixel, middle = 1 / _CAMERA.fx, torch.tensor([0.3, -0.2])
    for length, away, angle, aside in itertools.islice(itertools.product(LENGTHS, AWAY, ANGLES, ASIDE), 0, None, every):
        along = torch.tensor([math.cos(angle), math.sin(angle)])
        centre = pixel * (middle + away * length * along + aside * along.flip(0) * torch.tensor([-1.0, 1.0]))
        yield (
            f"{length:g} px, {away:g} deviations away, angle {angle:.2f}, {aside:g} px aside",
            Splats(
                means=torch.tensor([[*centre, 1.0]]),
                quats=torch.tensor([[math.cos(angle / 2), 0, 0, math.sin(angle / 2)]]),
                scales=torch.tensor([[length, 0.3, 0.3]]) * pixel, opacities=torch.tensor([0.9]),
                sh0=torch.tensor([[[0.9, 0.2, -0.5]]]), shN=torch.zeros(1, 0, 3),
            ),
        )  # fmt: skip


def measure(backends: Mapping[str, Rasterizer], *, every: int = 1) -> Iterator[Row]:
    """The image and the gradients of every case and every needle, by each backend."""
    yield from _measured("single Gaussians", cases(every), backends, _IMAGE, _GRADIENT)
    yield from _measured("needles", needles(every), backends, *_OF_NEEDLES)


def _measured(
    what: str,
    table: Iterable[tuple[str, Splats]],
    backends: Mapping[str, Rasterizer],
    of_image: float,
    of_gradient: float,
) -> Iterator[Row]:
    """The image and the gradients of each Gaussian.

    The rotation's gradient is measured against the quaternion's own scale: ‖g_quat‖ · ‖q‖, which does not depend on ‖q‖.
    """
    exact = ReferenceRasterizer(**CLEAN)
    v = torch.randn(1, 9, 9, 3, generator=torch.Generator().manual_seed(0))
    images, gradients = ({name: Worst() for name in backends} for _ in range(2))
    for where, splats in table:
        reference = exact(splats.to(torch.float64), _CAMERA)
        expected = reference.vjp(v.double()) if bool(reference.visible.any()) else None
        for name, draw in backends.items():
            rendering = draw(splats, _CAMERA)
            images[name].add(float((rendering.image.double() - reference.image).abs().max()), where)
            if expected is not None:
                gradients[name].add(_gradient_error(rendering.vjp(v), expected, splats), where)
    for name in backends:
        yield images[name].row(f"{what}: image", name, of_image)
        yield gradients[name].row(f"{what}: gradient", name, of_gradient)


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
