"""A host whose tensors are on another device than the CPU, with the strategies: no operation finds tensors of both."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.utils import backend_registration

ROOT = Path(__file__).parents[2]
STRATEGIES = ["best", "splatsure"]  # together all strategies


def run(code):
    return subprocess.run([sys.executable, *code], cwd=ROOT, capture_output=True, text=True, check=False)


pytestmark = pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason=f"torch {torch.__version__} has no devices written in Python",
)


def test_the_other_device_does_not_mix_with_the_cpu():
    code = (
        "import torch; from tests.helpers.elsewhere import NAME, Elsewhere\n"
        "with Elsewhere():\n"
        "    x = torch.ones(3, device=NAME, requires_grad=True); (x * 2).sum().backward(); print(x.grad.device, x.tolist())\n"
        "    x * torch.ones(3)"
    )
    ran = run(["-c", code])
    assert ran.stdout == "elsewhere:0 [1.0, 1.0, 1.0]\n"
    assert "Expected all tensors to be on the same device" in ran.stderr


@pytest.mark.slow
def test_strategies_train_in_a_gsplat_loop_elsewhere():
    pytest.importorskip("gsplat")
    ran = run(["-m", "tests.helpers.gsplat_elsewhere", *STRATEGIES])
    assert ran.returncode == 0, ran.stderr
    assert [line.split()[0] for line in ran.stdout.splitlines()] == STRATEGIES
