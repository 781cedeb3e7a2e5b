"""Importing an adapter brings no heavy library into the host."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("cv2", "gsplat", "hydra", "kornia", "matplotlib", "nerfstudio", "open3d", "scipy", "skimage", "warp")


@pytest.mark.parametrize("module", ["integration", "integration.gsplat", "integration.inria", "integration.nerfstudio"])
def test_importing_an_adapter_is_light(module):
    code = f"import sys, {module}; print([name for name in {HEAVY!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"
