"""Copies of small CPU tensors to a device. Unlike `Tensor.new_tensor`, the host does not wait for the device's queued work."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import Color


def sent(numbers: Tensor, device: torch.device) -> Tensor:
    """A small CPU tensor, copied to the device without waiting."""
    return numbers.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else numbers


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def color_on(color: Color, device: torch.device, dtype: torch.dtype = torch.float32) -> Float[Tensor, "1 3"]:
    """A colour on the device. Its memory is shared: it must not be changed in place."""
    return sent(torch.tensor([color], dtype=dtype, device="cpu"), device)
