"""A safetensors file, tensor by tensor: as the library writes it, all tensors are in memory twice more.

The format: the header's length in 8 bytes, the header as JSON, then the tensors' bytes. The library reads it.
https://github.com/huggingface/safetensors#format
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Final

import torch
from torch import Tensor

# In the order in which the library writes them: wide types first, so that every tensor is aligned.
_TYPES: Final = {
    torch.int64: "I64", torch.float64: "F64", torch.float32: "F32", torch.int32: "I32", torch.bfloat16: "BF16",
    torch.float16: "F16", torch.int16: "I16", torch.int8: "I8", torch.uint8: "U8", torch.bool: "BOOL",
}  # fmt: skip
_ALIGNMENT: Final = 8  # bytes; of the header, so that the first tensor is aligned


def parts(tensors: Mapping[str, Tensor]) -> Iterator[bytes | memoryview]:
    """The pieces of the file in their order; a tensor's is a view of its memory. Tensors on a device are copied one by one.

    Raises:
        ValueError: a tensor's type has no name in the format.
    """
    types = list(_TYPES)
    order = sorted(tensors.items(), key=lambda item: (types.index(item[1].dtype), item[0]))
    header, end = dict[str, object](), 0
    for name, x in order:
        start, end = end, end + x.nbytes
        header[name] = {"dtype": _TYPES[x.dtype], "shape": list(x.shape), "data_offsets": [start, end]}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    yield len(text).to_bytes(8, "little") + text
    for _, x in order:
        yield x.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data
