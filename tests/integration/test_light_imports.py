"""Importing the library, an adapter or the geometry brings no heavy library into the host."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.command_line import started

ROOT = Path(__file__).resolve().parents[2]
HEAVY = {
    *["cv2", "gsplat", "hydra", "kornia", "matplotlib", "msgspec", "nerfstudio", "open3d", "scipy", "skimage", "warp"]
}
HOSTS = [f"integration.{host}" for host in ("gsplat", "inria", "nerfstudio")]
MODULES = ["clear_strategies", "rasterizers", "integration", *HOSTS, "clear_strategies.geometry"]


def test_importing_is_light():
    code = (
        "import importlib, sys\n"
        f"for module in {MODULES}:\n"
        "    importlib.import_module(module)\n"
        f"    assert not sys.modules.keys() & {HEAVY}, module\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_messages_are_shown_where_the_host_has_not_configured_logging(tmp_path):
    setup, said = (
        "logging.basicConfig(format='theirs %(message)s', level='INFO')",
        "logging.getLogger('integration.x').info('said')",
    )
    alone = f"import logging; from clear_strategies.console import show_in_host; show_in_host(); {said}"
    configured = alone.replace("show_in_host();", f"{setup}; show_in_host();")
    for name, code, shown in (("alone", alone, "[clear] said\n"), ("configured", configured, "theirs said\n")):
        assert started("-c", code, cwd=tmp_path, said=tmp_path / name).wait() == 0
        assert (tmp_path / name).read_text() == shown
