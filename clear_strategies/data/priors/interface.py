"""The interface of priors, which make the super-resolved (SR) image of each view; bicubic; the disk cache of networks' results;
and functions that priors share.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import tempfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.errors import DataError, SettingError
from clear_strategies.files import read_bytes

_log = logging.getLogger(__name__)

AS_EXPECTED: Final = "it shows this view, and is RGB in [0, 1]"
"""The advice that `warn_if_far_from_lr` gives by default."""
_USUAL_DISTANCE: Final = 0.03  # mean |D(SR) - LR|; bicubic and the small networks stay near 0.01 on real photos


@runtime_checkable
class Prior(Protocol):
    """A frozen image super-resolution model."""

    @property
    def label(self) -> str:
        """One phrase for the plan and the tables."""
        ...

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        """The SR image of the view called `name`: `factor` times as large as `lr`, in [0, 1], on 8-bit steps."""
        ...


@dataclass(frozen=True, slots=True)
class Bicubic:
    """U(I_LR), which adds no detail."""

    label: str = field(default="bicubic (no detail beyond LR)", init=False)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        return images.quantize(images.upsample(lr, factor))


class SuperResolved(NamedTuple):
    """The SR image of a view, and `View.disagreement`: None unless the network's image was changed."""

    image: Float[Tensor, "H W 3"]
    disagreement: Float[Tensor, "h w 3"] | None = None


def super_resolved(prior: Any, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> SuperResolved:
    """Call a prior, or any function with its arguments; a DataError if the result is not an SR image of `lr`."""
    own = getattr(prior, "super_resolved", None)
    result: SuperResolved = own(name, lr, factor) if own else SuperResolved(prior(name, lr, factor))
    image, (h, w) = result.image, lr.shape[:2]
    if not isinstance(image, Tensor) or not image.is_floating_point():
        kind = image.dtype if isinstance(image, Tensor) else f"a {type(image).__name__}"
        problem = f"must be a float tensor [H, W, 3] in [0, 1], got {kind}"
        raise DataError(name, "SR image", problem, "correct the prior")
    if image.shape != (h * factor, w * factor, 3):
        size = "x".join(map(str, (*image.shape[1::-1], *image.shape[2:]))).removesuffix("x3")
        problem = f"is {size}, but {factor} times {w}x{h} is {w * factor}x{h * factor}"
        raise DataError(name, "SR image", problem, "super-resolve the LR images that are trained on")
    return result


@runtime_checkable
class Network(Prior, Protocol):
    """A prior whose result depends only on the LR image, the bytes of `files` and its own fields. It can be cached."""

    @property
    def files(self) -> tuple[Path, ...]: ...


def network_of(prior: object) -> Network | None:
    """The network that a prior is or decorates; None if there is none."""
    while not (prior is None or isinstance(prior, Network)):
        prior = getattr(prior, "prior", None)
    return prior


def cache_folder() -> Path:
    """The folder of all caches: $CLEAR_CACHE, else ~/.cache/clear-strategies."""
    try:
        return Path(os.environ.get("CLEAR_CACHE") or "~/.cache/clear-strategies").expanduser()
    except RuntimeError:  # no $HOME, and a user without an account, as in a container
        return Path(tempfile.gettempdir(), "clear-strategies")


def cached(prior: Prior) -> Prior:
    """Wrap a network in a cache; any other prior is returned unchanged."""
    return Cached(prior) if isinstance(prior, Network) else prior


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
        image = super_resolved(self.prior, name, lr, factor).image.to(lr)
        result = images.quantize(image).contiguous()  # as read_image's: strides order sums
        try:
            write_png(file, result)
        except OSError as error:  # without the cache the run is slower, not wrong
            _warn_once(
                f"SR images cannot be cached in {self.folder} ({error.strerror}). $CLEAR_CACHE names another folder."
            )
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


@functools.cache
def _warn_once(message: str) -> None:
    _log.warning(message)


def fingerprint(network: Network) -> str:
    """The names of a network's files, each with the first 16 digits of its SHA-256."""
    digests = ((file.name, hashlib.sha256(file.read_bytes()).hexdigest()) for file in network.files)
    return ", ".join(f"{name} {digest[:16]}" for name, digest in digests)


def require_path(path: object, what: str) -> None:
    """Raise a SettingError unless a path has been given."""
    if not isinstance(path, str) or not path:
        raise SettingError(f"prior.path: must be {what}, got {path!r}: add prior.path=…")


def warn_if_far_from_lr(
    what: str,
    hr: Float[Tensor, "H W 3"],
    lr: Float[Tensor, "h w 3"],
    factor: int,
    check: str = AS_EXPECTED,
) -> None:
    """Warn if the HR image, reduced, differs from its LR image, as an image of another view, in BGR, or in [0, 255] does."""
    distance = float((images.downsample(hr, factor, "area") - lr).abs().mean())
    if distance > _USUAL_DISTANCE:
        _log.warning(
            "%s, reduced again, differs from its LR image by %.3f on average (usual: below %.2f); check that %s.",
            what, distance, _USUAL_DISTANCE, check,
        )  # fmt: skip


def checked_sr(
    what: str, sr: Float[Tensor, "H W 3"], lr: Float[Tensor, "h w 3"], factor: int, check: str = AS_EXPECTED
) -> Float[Tensor, "H W 3"]:
    """Round `sr` to 8-bit steps, move it to the device of `lr`, and compare it by `warn_if_far_from_lr`."""
    result = images.quantize(sr).to(lr)
    warn_if_far_from_lr(f"{what}: the SR image", result, lr, factor, check)
    return result
