"""Importing an adapter, or the geometry, brings no heavy library into the host."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("cv2", "gsplat", "hydra", "kornia", "matplotlib", "nerfstudio", "open3d", "scipy", "skimage", "warp")


MODULES = (
    "integration", "integration.gsplat", "integration.inria", "integration.nerfstudio", "clear_strategies.geometry",
)  # fmt: skip


@pytest.mark.parametrize("module", MODULES)
def test_importing_is_light(module):
    code = f"import sys, {module}; print([name for name in {HEAVY!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"


def test_messages_are_shown_where_the_host_has_not_configured_logging():
    code = "import logging; from integration.log import show_log; show_log(); logging.getLogger('integration.x').info('said')"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stderr == "[clear] said\n"
    configured = code.replace(
        "show_log();", "logging.basicConfig(format='theirs %(message)s', level='INFO'); show_log();"
    )
    result = subprocess.run([sys.executable, "-c", configured], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stderr == "theirs said\n"
