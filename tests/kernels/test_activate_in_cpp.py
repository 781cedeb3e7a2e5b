"""The activation in C++, beside the same in float64."""

import pytest
import torch

from clear_strategies.kernels import native
from clear_strategies.kernels.per_gaussian import cpp, reference
from rasterizers.native import kernel_threads
from tests.helpers.backends import needs

pytestmark = needs("cpp")
NAMES = ("scales", "filtered", "sigmoid", "coefficient", "factor", "opacities")


def raw(n: int, spread: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(n)
    filters = torch.randn(n, generator=g).clamp_min(0)
    return spread * torch.randn(n, 3, generator=g), 2 * spread * torch.randn(n, generator=g), filters


@pytest.mark.parametrize("gate", [None, torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "threads"), [(0, 1), (1, 1), (16, 1), (1_043, 2)])
def test_it_is_that_of_torch_to_its_rounding(n, threads, gate):
    for spread in (1.0, 6.0):
        parameters = raw(n, spread)
        z = None if gate is None else (1.25 * (torch.rand(n) > 0.2)).to(gate)
        with kernel_threads(threads):
            found = cpp.activate(*parameters, z)
        expected = reference.activate(*(x.double() for x in parameters), z)
        for name, x, y in zip(NAMES, found, expected, strict=True):
            torch.testing.assert_close(x.double(), y, rtol=8e-7, atol=1e-36, msg=name)


def test_what_is_out_of_range_is_as_in_torch():
    scales = torch.tensor([[-60.0, 0.0, 1.0], [torch.nan, 0.0, 1.0], [torch.inf, 0.0, 1.0], [0.0, 0.0, 0.0]])
    logits, filters = torch.tensor([200.0, -80.0, 0.0, torch.nan]), torch.tensor([0.0, 0.0, 1.0, 1.0])
    # The reference takes float64 tensors; these fit float32 as well.
    expected = [x.float() for x in reference.activate(scales.double(), logits.double(), filters.double(), None)]
    for name, x, y in zip(NAMES, cpp.activate(scales, logits, filters, None), expected, strict=True):
        torch.testing.assert_close(x, y, rtol=8e-7, atol=1e-34, equal_nan=True, msg=name)


def test_shapes_that_do_not_belong_together_are_refused():
    module, (scales, logits, filters) = native.module(), raw(5, 1.0)
    rows, columns = torch.empty(2, 5, 3), torch.empty(4, 5)
    with pytest.raises(ValueError, match=r"scales must be \[N, 3\]"):
        module.activate(scales, logits, filters[:4], None, rows, columns, 1)
    with pytest.raises(ValueError, match=r"columns \[4, N\]"):
        module.activate(scales, logits, filters, None, rows, torch.empty(4, 6), 1)
