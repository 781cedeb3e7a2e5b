"""The tensor in which a host keeps the screen gradient: units, packed rows, absolute gradients."""

from __future__ import annotations

import pytest
import torch

from integration.autograd_shot import ScreenGradientSlot


def test_a_gradient_in_ndc_is_converted_to_pixels():
    slot = ScreenGradientSlot(torch.zeros(2, 3), (200, 100), to_pixels=(2 / 200, 2 / 100))
    gradient = slot.per_gaussian(torch.tensor([[4.0, 0.0, 9.0], [0.0, 3.0, 9.0]]), 2)
    assert torch.allclose(gradient, torch.tensor([[0.04, 0.0], [0.0, 0.06]]))


@pytest.mark.parametrize("to_pixels", [(1.0, 1.0), (2 / 200, 2 / 100)], ids=["gsplat", "inria"])
def test_written_norms_are_in_ndc(to_pixels):
    tensor = torch.zeros(1, 3, 2, requires_grad=True)
    slot = ScreenGradientSlot(tensor, (200, 100), to_pixels)
    slot.write(torch.tensor([0.5, 0.0, 2.0]))
    pixels = slot.per_gaussian(tensor.grad, 3)
    assert torch.allclose((pixels * torch.tensor([100.0, 50.0])).norm(dim=1), torch.tensor([0.5, 0.0, 2.0]))


def test_packed_rows_are_those_of_their_gaussians():
    tensor = torch.zeros(2, 2, requires_grad=True)
    slot = ScreenGradientSlot(tensor, (2, 2), rows=torch.tensor([3, 1]))
    assert slot.per_gaussian(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), 4).tolist() == [[0, 0], [3, 4], [0, 0], [1, 2]]
    slot.write(torch.tensor([9.0, 5.0, 9.0, 7.0]))
    assert tensor.grad.tolist() == [[7, 0], [5, 0]]


def test_gsplats_absolute_gradient_is_written_too():
    tensor = torch.zeros(1, 2, 2, requires_grad=True)
    tensor.absgrad = torch.ones(1, 2, 2)
    ScreenGradientSlot(tensor, (2, 2)).write(torch.tensor([1.0, 2.0]))
    assert tensor.absgrad[0, :, 0].tolist() == [1, 2]
