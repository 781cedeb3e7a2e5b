"""The ablation and two requeues on a real Slurm. It starts daemons and takes minutes, so it has to be asked for:
CLEAR_TEST_SLURM=1 python -m pytest tests/slurm
"""

from __future__ import annotations

import os
from importlib.util import find_spec

import pytest

from tests.slurm import ablation_and_requeue, one_machine


@pytest.mark.skipif(not os.environ.get("CLEAR_TEST_SLURM"), reason="not asked for: CLEAR_TEST_SLURM=1")
@pytest.mark.skipif(
    bool(one_machine.missing()),
    reason=f"Slurm is not installed (Debian: apt install slurm-wlm munge): {', '.join(one_machine.missing())}",
)
@pytest.mark.skipif(
    find_spec("submitit") is None or find_spec("hydra_plugins") is None,
    reason="hydra-submitit-launcher is not installed: pip install -e '.[sweeps]'",
)
def test_the_ablation_and_jobs_that_are_taken_away(tmp_path):
    ablation_and_requeue.main(tmp_path / "slurm")
