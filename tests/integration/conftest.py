"""The 3DGS-style host of tests/helpers/inria_host."""

import importlib
import sys

import pytest

from clear_strategies import Conductor
from integration.inria import attach
from integration.inria.__main__ import main
from tests.helpers import host_parts
from tests.helpers.host_parts import FOLDER, FROM_START


@pytest.fixture
def inria_host(monkeypatch):
    """Its train.py as a module. Its modules are unloaded after the test, since their names are common."""
    monkeypatch.syspath_prepend(str(FOLDER))
    yield importlib.import_module("train")
    for name in [m for m in sys.modules if m.split(".")[0] in ("train", "scene", "gaussian_renderer")]:
        del sys.modules[name]


@pytest.fixture
def inria_capture(tmp_path):
    """A folder with the SR images of the host's photos."""
    host_parts.write_sr(tmp_path)
    return tmp_path


@pytest.fixture
def inria_attached(inria_host, inria_capture):
    """`made(*strategies)`: CLEAR attached to a fresh model of the host, the model, and its scene. mask: of all photos."""

    def made(*strategies, objective=host_parts.HR_FROM_START, sr=inria_capture / "sr", mask=None, **settings):
        gaussians, scene = inria_host.setup(host_parts.options(inria_host, inria_capture))
        for camera in scene.cameras:
            camera.alpha_mask = mask
        conductor = Conductor(*strategies, objective=objective)
        return attach(gaussians, scene.cameras, conductor, sr=sr, **settings), gaussians, scene

    return made


@pytest.fixture
def inria_launched(inria_host, inria_capture, caplog):
    """`run(*arguments)`: the exit status of the host's train.py with CLEAR.

    Args:
        clear: more of CLEAR's options. change: (old, new), a text of the script.
    """
    caplog.set_level("INFO")

    def run(*arguments, clear=(), change=None):
        script = FOLDER / "train.py"
        if change is not None:
            changed = script.read_text().replace(*change)
            script = inria_capture / "changed.py"
            script.write_text(changed)
        options = ["--sr", inria_capture / "sr", *(f"--overrides={row}" for row in FROM_START), *clear]
        return main([*map(str, (*options, script, "-s", inria_capture, *arguments))])

    return run
