"""The 3DGS-style host of tests/helpers/inria_host."""

from __future__ import annotations

import importlib
import sys

import pytest

from clear_strategies import Conductor
from integration.inria import attach
from tests.helpers import inria, toy


@pytest.fixture
def inria_host(monkeypatch):
    """Its train.py as a module. Its modules are unloaded after the test, since their names are common."""
    monkeypatch.syspath_prepend(str(inria.FOLDER))
    yield importlib.import_module("train")
    for name in [m for m in sys.modules if m.split(".")[0] in ("train", "scene", "gaussian_renderer")]:
        del sys.modules[name]


@pytest.fixture
def inria_capture(inria_host, tmp_path):
    """A folder with the LR photos and SR images of the toy scene."""
    importlib.import_module("scene").write(tmp_path, toy.scene(inria.N))
    return tmp_path


@pytest.fixture
def inria_attached(inria_host, inria_capture):
    """`made(*strategies)`: CLEAR attached to a fresh model of the host, the model, and its scene."""

    def made(*strategies, objective=inria.HR_FROM_START, sr=inria_capture / "sr", **settings):
        gaussians, scene = inria_host.setup(inria.options(inria_host, inria_capture))
        return (
            attach(gaussians, scene.cameras, Conductor(*strategies, objective=objective), sr=sr, **settings),
            gaussians,
            scene,
        )

    return made
