"""A disk cache of the SR images of networks, by content."""

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
    """The folder of all caches: $CLEAR_CACHE, else ~/.cache/clear-strategies."""
    return Path(os.environ.get("CLEAR_CACHE") or Path.home() / ".cache" / "clear-strategies").expanduser()


def cached(prior: Prior) -> Prior:
    """Wrap a network in a cache; any other prior is returned unchanged."""
    return Cached(prior) if isinstance(prior, Network) else prior


def kept_network_of(prior: object) -> Prior | None:
    """The network that a prior is or decorates, as of `network_of`, but with its cache if it has one."""
    return next((inner for inner in layers(prior) if isinstance(inner, Network | Cached)), None)


@dataclass(frozen=True, slots=True)
class Cached:
    """Caches a network's results by LR image, factor, the bytes of the model and its settings.

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
        result = images.quantize(self.prior(name, lr, factor)).contiguous()  # as read_image's: strides order sums
        try:
            write_png(file, result)
        except OSError as error:  # without the cache the run is slower, not wrong
            _log.warning("the SR image of %s cannot be cached in %s (%s).", name, self.folder, error.strerror)
        return result

    def _key(self, lr: Float[Tensor, "h w 3"], factor: int) -> str:
        """A hash of all inputs but the model's path, so that a moved or linked model has the same results."""
        settings = {f.name: getattr(self.prior, f.name) for f in fields(self.prior) if f.compare and f.name != "path"}  # type: ignore[arg-type]
        identity = (type(self.prior).__name__, settings, factor, tuple(lr.shape), str(lr.dtype))
        digest = hashlib.sha256(repr(identity).encode())
        digest.update(lr.cpu().contiguous().numpy().tobytes())
        for file in self.prior.files:
            digest.update(hashlib.sha256(read_bytes(file, remedy="set prior.path to the model")).digest())
        return digest.hexdigest()
