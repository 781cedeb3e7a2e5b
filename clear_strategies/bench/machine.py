"""The machine and the versions that a figure belongs to; nothing that names its user or folders."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from typing import Any

import torch

from clear_strategies.provenance import provenance


def machine(threads: int) -> dict[str, Any]:
    """What to write beside every figure; what cannot be known is "unknown"."""
    facts = provenance()
    return {
        "date": facts["date"],
        "cpu": facts["platform"].partition(", ")[2],
        "system": f"{platform.system()} {platform.machine()}",
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": threads,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "simd": torch.backends.cpu.get_cpu_capability(),
        "load_average": [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else "unknown",
        "python": facts["python"],
        "compiler": _compiler(),
        "versions": {**facts["versions"], "torch": torch.__version__},
        "commit": facts["git"],
    }


def sentence(facts: dict[str, Any]) -> str:
    """One line below the tables."""
    versions, threads = facts["versions"], facts["threads"]
    parts = [
        f"{facts['cpu']}, {facts['cores']} cores, {threads} thread{'s' if threads > 1 else ''}",
        facts["gpu"],
        f"torch {versions['torch']}, numpy {versions.get('numpy', 'unknown')}, Python {facts['python']}",
        facts["compiler"],
        f"commit {str(facts['commit'])[:10]}{'+dirty' if str(facts['commit']).endswith('+dirty') else ''}",
        facts["date"][:10],
    ]
    return f"Measured on {'; '.join(part for part in parts if part not in ('unknown', 'none'))}."


def _compiler() -> str:
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return "unknown"
    try:
        said = subprocess.run([compiler, "--version"], capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return said.stdout.splitlines()[0].strip() if said.stdout else "unknown"
