"""Run an unchanged trainer where there is no GPU: `python -m integration.on_cpu [--strategies best …] train.py -s data`.

The trainer is one that draws with gsplat, as nerfstudio's splatfacto does, or a 3DGS-style one, which has a module
`gaussian_renderer`.
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Final

import rasterizers
from clear_strategies.errors import HostError
from integration import launcher
from integration.gsplat.__main__ import TRAINER as GSPLAT
from integration.inria.__main__ import TRAINER as INRIA
from integration.on_cpu import cuda, diff_gaussian_rasterization, fused_ssim, gsplat_functions
from integration.on_cpu.simple_knn import distances_and_indices
from integration.settings import Settings

_log = logging.getLogger("integration.on_cpu")  # __name__ is "__main__" here

REFUSED: Final = {
    "with_ut": "leave it out: 3DGUT's projection is gsplat's alone",
    "with_eval3d": "leave it out: 3DGUT's projection is gsplat's alone",
    **dict.fromkeys(
        ("camera_model=fisheye", "camera_model=ftheta", "camera_model=ortho"), "train on photos of a pinhole camera"
    ),
    "compression": "compress the result on a GPU",
    "use_fused_bilagrid": "use_bilateral_grid alone does the same in torch",
    "bilateral_grid_fused": "post_processing=bilateral_grid alone does the same in torch",
    "post_processing=ppisp": "post_processing=bilateral_grid",
    "optimizer_type=sparse_adam": "optimizer_type=default",
    "compute_cov3D_python": "leave it out: the rasterizer computes them",
    "ray_jitter": "leave it out",
    "use_confidence": "leave it out",
}
"""Options of trainers, or single values of them, that need CUDA; and what to do instead."""
_RETURNS_INDICES: Final = re.compile(r"std::tuple|\w, *\w+ *= *distCUDA2\(")
"""Of FSGS's distCUDA2: its declaration, or a call of it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a trainer on the CPU; returns the exit status."""
    parser = launcher.parser("integration.on_cpu", "Run an unchanged trainer without a GPU, alone or with CLEAR.")
    parser.set_defaults(strategies=None)
    options = parser.parse_args(arguments)
    if options.strategies is None:
        _require_strategies(parser, options)
    elif _is_of_nerfstudio(options.script):
        parser.error(
            "--strategies has no effect on nerfstudio's scripts, whose method clear-splatfacto has the strategies. Use, e.g.: "
            f"{options.script} clear-splatfacto --pipeline.model.strategies {options.strategies} …"
        )
    return launcher.run(options, lambda: prepared(options.script, options.rest))


def prepared(script: Path, arguments: Sequence[str] = ()) -> launcher.Trainer:
    """Replace what needs CUDA, for this script and from here on.

    Raises:
        HostError: an option of the script needs CUDA.
    """
    given = set(_given(arguments))
    refused = [f"--{option} needs CUDA; on a CPU, {remedy}." for option, remedy in REFUSED.items() if option in given]
    if refused:
        raise HostError(" ".join(refused))
    found = importlib.util.find_spec("gaussian_renderer")
    renderer = None if found is None or found.origin is None else Path(found.origin).parent
    cuda.replace()
    sys.meta_path.append(_OwnRasterizers)
    sys.modules |= {
        "diff_gaussian_rasterization": diff_gaussian_rasterization, "fused_ssim": fused_ssim,
        "simple_knn": ModuleType("simple_knn"), "simple_knn._C": _knn(renderer),
    }  # fmt: skip
    sources = [] if renderer is None else [file.read_text(encoding="utf-8") for file in renderer.glob("*.py")]
    draws_with_gsplat = renderer is None or any("gsplat" in source for source in sources)
    if draws_with_gsplat and importlib.util.find_spec("gsplat") is not None:
        gsplat_functions.replace()
    _log.info("CUDA means the CPU here; images are drawn by rasterizer=%s.", rasterizers.fastest("cpu"))
    return GSPLAT if renderer is None else INRIA


class _OwnRasterizers:
    """Behind all finders of modules: what a fork names its rasterizer, e.g. diff_surfel_rasterization, or imports of one, e.g.
    diff_gaussian_rasterization._C, and none of them finds.
    """

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> None:
        if "rasterization" in name:
            raise diff_gaussian_rasterization.OwnRasterizerError(f"the module {name}")


def _is_of_nerfstudio(script: Path) -> bool:
    return (
        script.is_file()
        and re.search(rb"^\s*(from|import) nerfstudio\b", script.read_bytes(), re.MULTILINE) is not None
    )


def _knn(renderer: Path | None) -> Any:
    """`simple_knn._C` as the sources beside the renderer declare it, or call it, where its submodules are not there: in FSGS it
    returns indices, too.
    """
    root = Path() if renderer is None else renderer.parent
    sources = (root / "submodules" / "simple-knn" / "spatial.h", root / "scene" / "gaussian_model.py")
    indices = any(_RETURNS_INDICES.search(file.read_text(encoding="utf-8")) for file in sources if file.is_file())
    return _Knn(distCUDA2=distances_and_indices if indices else lambda points: distances_and_indices(points)[0])


class _Knn(SimpleNamespace):
    """simple_knn._C. A function that a fork adds to it is told in one line."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise diff_gaussian_rasterization.OwnRasterizerError(f"simple_knn._C.{name}")


def _given(arguments: Sequence[str]) -> Iterator[str]:
    """The options among the arguments, as `name` and as `name=value`."""
    for word, following in pairwise([*arguments, ""]):
        if word.startswith("--"):
            name, _, value = word[2:].partition("=")
            yield from (name.replace("-", "_"), f"{name.replace('-', '_')}={value or following}")


def _require_strategies(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Options of the strategies would do nothing without them."""
    for name in (*(f.name for f in fields(Settings)), "save_lr"):
        if getattr(options, name) != parser.get_default(name):
            parser.error(f"--{name.replace('_', '-')} has no effect without --strategies, e.g. --strategies best.")


if __name__ == "__main__":
    sys.exit(main())
