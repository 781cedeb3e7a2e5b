"""The machine and the versions that a figure belongs to; nothing that names its user or folders."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from importlib import metadata
from typing import Any, Final

import torch

from clear_strategies.outputs.provenance import provenance

_ON_CUDA: Final = ("warp-lang", "gsplat", "gswarp", "fused-ssim")


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
        "cuda": _cuda() if torch.cuda.is_available() else {},
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
    cuda = facts.get("cuda", {})
    libraries = "".join(f", {name} {version}" for name, version in cuda.get("versions", {}).items())
    parts = [
        f"{facts['cpu']}, {facts['cores']} cores, {threads} thread{'s' if threads > 1 else ''}",
        f"{facts['gpu']}, driver {cuda['driver']}, CUDA {cuda['toolkit']}{libraries}" if cuda else facts["gpu"],
        f"torch {versions['torch']}, numpy {versions.get('numpy', 'unknown')}, Python {facts['python']}",
        facts["compiler"],
        f"commit {str(facts['commit'])[:10]}{'+dirty' if str(facts['commit']).endswith('+dirty') else ''}",
        facts["date"][:10],
    ]
    return f"Measured on {'; '.join(part for part in parts if part not in ('unknown', 'none'))}."


def _cuda() -> dict[str, Any]:
    """What torch says of the GPU, which differs with its version; what it can do is measured in `peaks`."""
    properties = torch.cuda.get_device_properties()
    names = (
        "multi_processor_count", "total_memory", "L2_cache_size", "clock_rate", "memory_clock_rate", "memory_bus_width",
    )  # fmt: skip
    return {
        "driver": _said("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"),
        "toolkit": torch.version.cuda,
        "capability": f"{properties.major}.{properties.minor}",
        **{name: getattr(properties, name) for name in names if hasattr(properties, name)},
        "versions": {name: found for name in _ON_CUDA if (found := _version(name)) is not None},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _compiler() -> str:
    compiler = shutil.which("g++") or shutil.which("clang++")
    return _said(compiler, "--version") if compiler is not None else "unknown"


def _said(*command: str) -> str:
    """The first line of what a program says."""
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return said.stdout.splitlines()[0].strip() if said.stdout else "unknown"
