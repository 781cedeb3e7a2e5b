"""Super-resolution: networks in ONNX that cannot be used, and SR images that do not belong to their photos."""

import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from clear_strategies.core import images
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.priors import Images, Onnx
from tests.helpers.networks import onnx_bytes, photo, upscaling_weight
from tests.stress.bad_inputs import BadInput, Canary, at

_LR = (8, 12)


def _onnx(content: bytes, **options: Any) -> Callable[[Path], object]:
    return at("net.onnx", lambda path: _enlarged(path, **options), content)


def _enlarged(path: Path, **options: Any) -> object:
    return Onnx(str(path), **options)("view", photo(*_LR), 4)


def _external(location: str) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        weight = upscaling_weight()
        (folder / "models").mkdir()
        for there in (folder / "secret.bin", folder / "models" / "beside.bin"):
            there.write_bytes(weight.numpy().astype("<f4").tobytes())
        path = folder / "models" / "external.onnx"
        path.write_bytes(onnx_bytes(weight, external=location.format(folder=folder)))
        return _enlarged(path)

    return give


def _images(spoil: Callable[[Path], object], *, suffix: str = "", view: str = "a.png") -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        write_png(folder / "sr" / "a.png", images.upsample(photo(*_LR), 4))
        spoil(folder / "sr")
        return Images(str(folder / "sr"), suffix=suffix)(view, photo(*_LR), 4)

    return give


def _two_views_of_one_image(folder: Path) -> object:
    write_png(folder / "0001.png", images.upsample(photo(*_LR), 4))
    prior = Images(str(folder))
    prior("cam1/0001.png", photo(*_LR), 4)
    return prior("cam2/0001.png", photo(*_LR), 4)


_GOOD = onnx_bytes(upscaling_weight())
_CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no path": (lambda folder: Onnx(), "prior.path: must be a network in ONNX, got ''"),
    "path absent": (at("none.onnx", _enlarged), "none.onnx: "),
    "path is a folder": (_enlarged, ": "),
    "tiles all overlap": (_onnx(_GOOD, tile=16, overlap=4), "prior.tile: 0 <= 4 overlap < tile must hold"),
    "tile of 0": (_onnx(_GOOD, tile=0, overlap=0), "prior.tile: "),
    "empty network": (_onnx(b""), "net.onnx: "),
    "network in words": (_onnx(b"not a network at all"), "net.onnx: "),
    "network that is a pickle": (_onnx(pickle.dumps(Canary(Path("canary")))), "net.onnx: "),
    "network cut to 500 bytes": (_onnx(_GOOD[:500]), "net.onnx: "),
    "network for another factor": (_onnx(onnx_bytes(upscaling_weight(scale=2), scale=2)), "where .* is expected: use a x4"),
    "network that makes NaN": (_onnx(onnx_bytes(upscaling_weight() * math.nan)), "net.onnx: output: is not finite"),
    "network that makes millions": (_onnx(onnx_bytes(upscaling_weight() * 1e9)), "net.onnx: output: "),
    "weights at an absolute path": (_external("{folder}/secret.bin"), "external.onnx: weights: lie in other files"),
    "weights in a file beside": (_external("beside.bin"), "external.onnx: weights: lie in other files"),
    "SR folder absent": (lambda folder: Images(str(folder / "none"))("a.png", photo(*_LR), 4), "folder: is not there"),
    "SR image absent": (_images(lambda sr: None, view="b.png"), "b: has no SR image b"),
    "SR image without its suffix": (_images(lambda sr: None, suffix="_x4"), "a: has no SR image a_x4"),
    "two SR images of one view": (_images(lambda sr: (sr / "a.jpg").write_bytes(b"twin")), "for one view: keep one"),
    "one SR image of two views": (_two_views_of_one_image, "would be that of two views"),
    "SR image of the LR size": (_images(lambda sr: write_png(sr / "a.png", photo(*_LR))), "is 12x8 where 48x32 is expected"),
    "SR image turned": (_images(lambda sr: write_png(sr / "a.png", photo(48, 32))), "a.png: size: is 32x48"),
}  # fmt: skip
INPUTS = [BadInput("SR model", name, give, pattern) for name, (give, pattern) in _CASES.items()]
