"""Small photos, and hand-made ONNX files that enlarge them: a convolution, then DepthToSpace."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from clear_strategies.core import images


def photo(height: int, width: int, seed: int = 0) -> Tensor:
    """Smooth and coloured, on 8-bit steps."""
    coarse = torch.rand(max(height // 4, 2), max(width // 4, 2), 3, generator=torch.Generator().manual_seed(seed))
    smooth = F.interpolate(coarse.permute(2, 0, 1)[None], size=(height, width), mode="bicubic").clamp(0.02, 0.98)
    return images.quantize(smooth[0].permute(1, 2, 0))


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def number(tag: int, value: int) -> bytes:
    return varint(tag << 3) + varint(value)


def block(tag: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return varint(tag << 3 | 2) + varint(len(data)) + data


def tensor(name: str, values: Tensor, external: str | None = None) -> bytes:
    head = b"".join(number(1, n) for n in values.shape) + number(2, 1) + block(8, name)
    if external is None:
        return head + block(9, values.numpy().astype("<f4").tobytes())
    return head + block(13, block(1, "location") + block(2, external)) + number(14, 1)


def value_info(name: str, *sizes: int | str) -> bytes:
    dims = b"".join(block(1, number(1, s) if isinstance(s, int) else block(2, s)) for s in sizes)
    return block(1, name) + block(2, block(1, number(1, 1) + block(2, dims)))


def attribute(name: str, value: int | str | list[int]) -> bytes:
    if isinstance(value, int):
        return block(1, name) + number(3, value) + number(20, 2)
    if isinstance(value, str):
        return block(1, name) + block(4, value) + number(20, 3)
    return block(1, name) + b"".join(number(8, v) for v in value) + number(20, 7)


def node(kind: str, inputs: list[str], output: str, **attributes: int | str | list[int]) -> bytes:
    body = b"".join(block(1, name) for name in inputs) + block(2, output) + block(3, kind) + block(4, kind)
    return body + b"".join(block(5, attribute(name, value)) for name, value in attributes.items())


def onnx_bytes(weight: Tensor, *, scale: int = 4, external: str | None = None) -> bytes:
    edge = weight.shape[-1]
    conv = node("Conv", ["lr", "weight"], "bands", kernel_shape=[edge, edge], pads=[edge // 2] * 4, strides=[1, 1])
    shuffle = node("DepthToSpace", ["bands"], "sr", blocksize=scale, mode="CRD")
    graph = block(1, conv) + block(1, shuffle) + block(2, "x4") + block(5, tensor("weight", weight, external))
    graph += block(11, value_info("lr", 1, 3, "h", "w")) + block(12, value_info("sr", 1, 3, "H", "W"))
    return number(1, 8) + block(7, graph) + block(8, block(1, "") + number(2, 13))


def upscaling_weight(edge: int = 5, scale: int = 4) -> Tensor:
    """Near-identity: each HR pixel is its LR pixel plus a little of the neighbours."""
    weight = torch.randn(3 * scale**2, 3, edge, edge, generator=torch.Generator().manual_seed(edge)) * 0.003
    for band in range(3 * scale**2):
        weight[band, band // scale**2, edge // 2, edge // 2] += 1
    return weight


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(max(float((a - b).square().mean()), 1e-12))


@dataclass(frozen=True)
class Counting:
    """Nearest-neighbour upsampling that keeps the names of the views it was called for."""

    path: str = ""
    setting: int = 0
    calls: list[str] = field(default_factory=list, compare=False)

    label = "counting"

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.path),) if self.path else ()

    def __call__(self, name: str, lr: Tensor, factor: int) -> Tensor:
        self.calls.append(name)
        return images.upsample(lr, factor, "nearest") + 0.001
