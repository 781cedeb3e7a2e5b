"""The benchmark's command line. Exit codes: 0, 2 for arguments or input that cannot be used, 130 and 143
when stopped by a signal.
"""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NoReturn

import torch

from clear_strategies.bench import iteration, kernels, pareto, rasterizers
from clear_strategies.bench.iteration import STRATEGIES
from clear_strategies.bench.kernels import SIZES
from clear_strategies.bench.output import Findings, between_markers, leave
from clear_strategies.bench.plot import time_against_error, time_against_quality
from clear_strategies.bench.rasterizers import SCENES
from clear_strategies.bench.scenes import NAMES
from clear_strategies.errors import ClearError, DataError
from rasterizers.interface import PRESETS, BackendUnavailable

_log = logging.getLogger(__name__)

_QUESTIONS: Final = {
    "rasterizers": "time, memory and error of every backend at every preset",
    "kernels": "image losses with their gradients and the per-Gaussian pass, ours and everyone's",
    "iteration": "one iteration of training, stage by stage",
    "pareto": "seconds against PSNR and SSIM of whole trainings",
}

Draw = Callable[[Path], None]


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see --help\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        _require_writable(options)
        findings, draw = _measure(options)
        text = leave(findings, json=options.json, markdown_file=options.markdown, docs=options.docs)
        encoding = sys.stdout.encoding or "utf-8"
        sys.stdout.write(text.encode(encoding, "replace").decode(encoding))  # a terminal may not know every sign
        if draw is not None and options.picture is not None:
            draw(options.picture)
    except (ClearError, BackendUnavailable) as error:
        _log.error("%s", error)
        return 2
    except OSError as error:
        _log.error("%s: %s", error.filename or "output", error.strerror or error)
        return 2
    except KeyboardInterrupt:
        _log.error("stopped; no table was written.")
        return 130
    return 0


def _measure(options: argparse.Namespace) -> tuple[Findings, Draw | None]:
    """What was found, and how to draw it where there is a picture."""
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    if options.question == "kernels":
        losses = kernels.Request(options.size, options.repeats, options.device, options.gaussians, _floors(options))
        return kernels.measure(losses, _log.info), None
    if options.question == "iteration":
        one = iteration.Request(
            options.scene, options.strategy, options.backend, options.preset, options.repeats,
            options.data, options.prototype, options.device, _floors(options),
        )  # fmt: skip
        return iteration.measure(one, _log.info), None
    if options.question == "pareto":
        whole = pareto.Request(
            tuple(options.overrides), options.seeds, options.iterations, options.out, tuple(options.backends),
            tuple(options.variants),
        )  # fmt: skip
        findings, trained = pareto.measure(whole, _log.info)
        return findings, lambda path: time_against_quality(path, trained, findings.sections[0].title)
    request = rasterizers.Request(
        options.scene, options.backend, options.preset, options.repeats, options.limit,
        options.device, options.data, options.prototype, options.memory, _floors(options),
    )  # fmt: skip
    findings, drawn = rasterizers.measure(request, _log.info)
    return findings, lambda path: time_against_error(path, drawn)


def _floors(options: argparse.Namespace) -> bool:
    return options.device == "cuda" if options.floors is None else bool(options.floors)


def _parser() -> argparse.ArgumentParser:
    common = _Parser(add_help=False)
    common.add_argument(
        "--threads", type=_positive, metavar="N", help="of torch and of the backends (default: torch's)"
    )
    common.add_argument("--json", type=Path, metavar="FILE", help="machine, versions and every repeat")
    common.add_argument("--markdown", type=Path, metavar="FILE", help="the tables")
    common.add_argument("--docs", type=Path, metavar="FILE", help="replace the tables between this page's markers")

    turns = _Parser(add_help=False)
    turns.add_argument("--repeats", type=_positive, default=9, metavar="N", help="turns of each (default 9)")

    turns.add_argument("--device", default="cpu", choices=["cpu", "cuda"], help="default: cpu")
    turns.add_argument(
        "--floors", action=argparse.BooleanOptionalAction,
        help="how near each stage comes to the device's bandwidth and arithmetic (default: on CUDA)",
    )  # fmt: skip

    splats = _Parser(add_help=False)
    splats.add_argument("--data", type=Path, metavar="PATH", help="the garden's .npz, or its folder")
    splats.add_argument("--prototype", type=Path, metavar="DIR", help="sources of the CPU prototype, a peer")

    parser = _Parser(prog="python -m clear_strategies.bench", description="Run time against error, on this machine.")
    questions = parser.add_subparsers(dest="question", required=True, metavar="QUESTION", parser_class=_Parser)
    ask = questions.add_parser("rasterizers", parents=[common, turns, splats], help=_QUESTIONS["rasterizers"])
    ask.add_argument(
        "--scene", nargs="+", default=list(SCENES), metavar="SCENE",
        help=f"{', '.join(NAMES)}, a .ply or a checkpoint (default: {' '.join(SCENES)})",
    )  # fmt: skip
    ask.add_argument("--backend", nargs="+", metavar="NAME", help="default: all that run here")
    ask.add_argument("--preset", nargs="+", default=list(PRESETS), choices=list(PRESETS), help="default: all")
    ask.add_argument("--limit", type=_seconds, default=180.0, metavar="S", help="skip what would take longer (180 s)")
    ask.add_argument("--no-memory", dest="memory", action="store_false", help="do not measure peak memory")
    ask.add_argument("--picture", type=Path, metavar="FILE", help="PNG: time against error")

    ask = questions.add_parser("kernels", parents=[common, turns], help=_QUESTIONS["kernels"])
    ask.add_argument("--size", nargs="+", default=list(SIZES), metavar="WxH", help=f"default: {' '.join(SIZES)}")
    ask.add_argument(
        "--gaussians", nargs="*", type=_positive, default=[100_000, 500_000], metavar="N",
        help="time the per-Gaussian pass of so many, too (default: 100000 500000)",
    )  # fmt: skip

    ask = questions.add_parser("iteration", parents=[common, turns, splats], help=_QUESTIONS["iteration"])
    ask.add_argument("--scene", default="s100k", metavar="SCENE", help="as above; HR is its image (default: s100k)")
    ask.add_argument("--strategy", default="clear", choices=list(STRATEGIES), help="default: clear")
    ask.add_argument("--backend", metavar="NAME", help="default: the fastest that runs here")
    ask.add_argument("--preset", default="fast", choices=list(PRESETS), help="default: fast")

    ask = questions.add_parser("pareto", parents=[common], help=_QUESTIONS["pareto"])
    ask.add_argument(
        "overrides", nargs="*", metavar="OVERRIDE", help="of all trainings, as for a run (default: the demo)"
    )
    ask.add_argument("--seeds", type=_seeds, default=(0, 1), metavar="S,S", help="default: 0,1")
    ask.add_argument("--iterations", type=_positive, default=1500, metavar="N", help="default: 1500")
    ask.add_argument(
        "--out", type=Path, default=Path("outputs/pareto"), metavar="FOLDER",
        help="of the trainings; those that are there are kept (default: %(default)s)",
    )  # fmt: skip
    ask.add_argument(
        "--backends", nargs="+", default=["auto"], metavar="NAME",
        help="the first trains all variants, each further one clear alone (default: the fastest)",
    )  # fmt: skip
    names = [variant.name for variant in pareto.VARIANTS]
    ask.add_argument("--variants", nargs="+", default=names, metavar="NAME", help=f"default: {', '.join(names)}")
    ask.add_argument("--picture", type=Path, metavar="FILE", help="PNG: time against quality")
    return parser


def _require_writable(options: argparse.Namespace) -> None:
    """What would fail after minutes of measuring fails before."""
    if options.docs is not None:
        between_markers(options.docs.read_text(encoding="utf-8"), options.question, "", source=options.docs)
    for path in (options.json, options.markdown, getattr(options, "picture", None)):
        if path is not None:
            if path.is_dir():
                raise DataError(path, "file", "is a folder", "name the file in it")
            path.parent.mkdir(parents=True, exist_ok=True)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return int(text)


def _seeds(text: str) -> tuple[int, ...]:
    if not all(part.isdecimal() for part in text.split(",")):
        raise argparse.ArgumentTypeError(f"must be whole numbers with commas between them, got {text!r}")
    return tuple(dict.fromkeys(int(part) for part in text.split(",")))


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not seconds > 0:
        raise argparse.ArgumentTypeError(f"must be a number of seconds above 0, got {text!r}")
    return seconds


if __name__ == "__main__":
    # Asked to stop, it still ends its worker and removes what it built.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.exit(main())
