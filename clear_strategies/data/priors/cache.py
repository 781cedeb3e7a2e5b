"""SR images of networks, kept on the disk by content."""

from __future__ import annotations

import hashlib
import logging
import os
from dataclasses import dataclass, field, fields
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors.interface import Network, Prior, layers
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes

_log = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Where results are kept that can be computed again: $CLEAR_CACHE, else ~/.cache/clear-strategies."""
    return Path(os.environ.get("CLEAR_CACHE") or Path.home() / ".cache" / "clear-strategies").expanduser()


def cached(prior: Prior) -> Prior:
    """The prior with a cache where it is a network, else the prior itself."""
    return Cached(prior) if isinstance(prior, Network) else prior


def kept_network_of(prior: object) -> Prior | None:
    """The network behind a prior, as `network_of` finds it, in its cache where it has one."""
    return next((inner for inner in layers(prior) if isinstance(inner, Network | Cached)), None)


@dataclass(frozen=True, slots=True)
class Cached:
    """A network whose results are kept, by LR image, factor, the model's bytes and its settings.

    Args:
        folder: of the results, PNG files; the default is ~/.cache/clear-strategies/sr, or $CLEAR_CACHE/sr.
    """

    prior: Network
    folder: Path = field(default_factory=lambda: cache_folder() / "sr")

    @property
    def label(self) -> str:
        return self.prior.label

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        file = self.folder / f"{self._key(lr, factor)}.png"
        if file.exists():
            try:
                result = read_image(file, expect=(lr.shape[1] * factor, lr.shape[0] * factor)).to(lr)
            except DataError as damaged:
                _log.warning("a cached SR image is damaged and is computed again: %s", damaged)
            else:
                _log.debug("%s: SR image from the cache (%s).", name, self.label)
                return result
        result = images.quantize(self.prior(name, lr, factor)).contiguous()  # as read_image's: sums have an order
        try:
            write_png(file, result)
        except OSError as error:  # without the cache the run is slower, not wrong
            _log.warning("the SR image of %s cannot be cached in %s (%s).", name, self.folder, error.strerror)
        return result

    def _key(self, lr: Float[Tensor, "h w 3"], factor: int) -> str:
        """A hash without the model's path: a moved or linked model is the same model."""
        settings = {f.name: getattr(self.prior, f.name) for f in fields(self.prior) if f.compare and f.name != "path"}  # type: ignore[arg-type]
        identity = (type(self.prior).__name__, settings, factor, tuple(lr.shape), str(lr.dtype))
        digest = hashlib.sha256(repr(identity).encode())
        digest.update(lr.cpu().contiguous().numpy().tobytes())
        for file in self.prior.files:
            digest.update(hashlib.sha256(read_bytes(file, remedy="set prior.path to the model")).digest())
        return digest.hexdigest()
