"""Packages that the trainers import and that a test does without: viewers, videos, trackers, networks that are downloaded."""

import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
import types

from PIL import Image

NAMES = ("torchvision", "viser", "nerfview", "mediapy", "wandb", "splines", "tensorly")


class Absent(types.ModuleType):
    """A module whose every name is a class that takes any arguments and does nothing."""

    __path__ = ()

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__init__": lambda self, *_, **__: None})


class NoExif(types.ModuleType):
    """piexif, for PNG files, which have none."""

    InvalidImageDataError = ValueError

    def load(self, path):
        raise ValueError


def save_image(image, path):
    """torchvision.utils.save_image of one image."""
    pixels = (image.detach() * 255 + 0.5).clamp(0, 255).byte().permute(1, 2, 0)
    Image.fromarray(pixels.numpy()).save(path)


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the packages `NAMES` that are not installed, and everything inside them."""

    def __init__(self):
        self.roots = {name for name in NAMES if importlib.util.find_spec(name) is None}

    def find_spec(self, name, path=None, target=None):
        return importlib.machinery.ModuleSpec(name, self) if name.split(".")[0] in self.roots else None

    def create_module(self, spec):
        module = Absent(spec.name)
        if spec.name == "torchvision":
            module.utils = types.SimpleNamespace(save_image=save_image)
        return module

    def exec_module(self, module):
        pass


sys.meta_path.append(Finder())
if os.environ["HOST"] == "gsplat-1.6.0":
    sys.modules["piexif"] = NoExif("piexif")
    sys.modules["gsplat.csrc"] = Absent("gsplat.csrc")  # its compiled module, which no test reaches
