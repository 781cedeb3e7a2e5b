"""The benchmark's command line.

Exit codes: 0; 2 for arguments or input that cannot be used; 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from clear_strategies import console
from clear_strategies.bench import rasterizers
from clear_strategies.bench.results import Results
from clear_strategies.bench.scenes import NAMES
from clear_strategies.commands.options import positive
from clear_strategies.errors import ClearError
from rasterizers.interface import PRESETS, BackendUnavailable

_log = logging.getLogger(__name__)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = vars(parser().parse_args(arguments))
    question, threads, out = options.pop("question"), options.pop("threads"), options["out"]
    console.show()
    if threads is not None:
        torch.set_num_threads(threads)
    shown: dict[str, Any] = {
        name: options[name] for name in ("device", "repeats", "iterations", "seeds") if name in options
    }
    results = Results(question, _log.info, shown)
    try:
        if out is not None:  # a folder that cannot be made is known before the measuring
            out.mkdir(parents=True, exist_ok=True)
        module: Any = import_module(f"clear_strategies.bench.{question}")
        if hasattr(module, "Request"):
            module.measure(results, module.Request(**options))
        else:
            module.measure(results, **{name: value for name, value in options.items() if name != "out"})
        sys.stdout.write(results.text())
        if out is not None:
            results.write(out)
    except (ClearError, BackendUnavailable) as error:
        _log.error("%s", error)
        return 2
    except OSError as error:
        _log.error("%s: %s", error.filename or "output", error.strerror or error)
        return 2
    except KeyboardInterrupt:
        _log.error("stopped; no tables were written.")
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """All questions and their options."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--threads", type=positive(int), metavar="N", help="threads of torch and the backends")
    out = argparse.ArgumentParser(add_help=False)
    out.add_argument(
        "--out", type=Path, metavar="FOLDER", help="write tables (CSV), figures (PNG) and the machine here"
    )
    turns = argparse.ArgumentParser(add_help=False)
    turns.add_argument(
        "--repeats", type=positive(int), default=9, metavar="N", help="turns of each contender (default 9)"
    )
    turns.add_argument("--device", default="cpu", choices=["cpu", "cuda"], help="default: cpu")
    garden = argparse.ArgumentParser(add_help=False)
    garden.add_argument("--data", type=Path, metavar="FILE", help="gsplat's test_garden.npz, the scene `garden`")

    result = argparse.ArgumentParser(prog="python -m clear_strategies.bench", description=__doc__)
    questions = result.add_subparsers(dest="question", required=True, metavar="QUESTION")
    scenes = f"{', '.join(NAMES)}, or a .ply"

    ask = questions.add_parser(
        "rasterizers", parents=[common, turns, garden, out], help="time, memory and error of every backend and preset"
    )
    ask.add_argument("--scene", nargs="+", default=list(rasterizers.SCENES), metavar="SCENE", help=scenes)
    ask.add_argument("--backend", nargs="+", metavar="NAME", help="default: all that run here")
    ask.add_argument(
        "--isa", nargs="+", choices=["avx512", "avx2", "baseline"], help="modules of cpp (default: the fastest here)"
    )
    ask.add_argument("--preset", nargs="+", default=list(PRESETS), choices=list(PRESETS), help="default: all")

    ask = questions.add_parser(
        "iteration", parents=[common, turns, garden, out], help="time and error of a training iteration, stage by stage"
    )
    ask.add_argument("--scene", default="s100k", metavar="SCENE", help=f"{scenes}; its image is the HR photo")
    ask.add_argument("--backend", metavar="NAME", help="default: the fastest that runs here")
    ask.add_argument("--preset", default="fast", choices=list(PRESETS), help="default: fast")

    _add_trainings(questions, common)
    what = "error, coverage and seconds of the depth of the training photos"
    ask = questions.add_parser("stereo", parents=[common, out], help=what)
    ask.add_argument("overrides", nargs="*", metavar="OVERRIDE", help="the data set, as for a run (default: the demo)")
    ask = questions.add_parser("errors", parents=[common, out], help="where a run's error on its test views lies")
    ask.add_argument("run", type=Path, metavar="RUN", help="the folder of a finished run")
    ask.add_argument("--reference", type=Path, metavar="RUN", help="another run of the same scene, beside it")
    return result


def _add_trainings(questions: Any, common: argparse.ArgumentParser) -> None:
    """The questions that are answered by whole trainings."""
    ask = questions.add_parser(
        "seconds", parents=[common], help="seconds until a variant is as good as the reference at its end"
    )
    ask.add_argument(
        "overrides", nargs="*", metavar="OVERRIDE", help="of all trainings, as for a run (default: the demo)"
    )
    ask.add_argument("--scene", nargs="+", default=[], metavar="SCENE", help="of conf/scene, one after the other")
    ask.add_argument(
        "--variant", nargs="*", action="append", required=True, dest="variants", metavar="OVERRIDE",
        help="a variant's own overrides, the reference first; once for each variant; none: the defaults",
    )  # fmt: skip
    ask.add_argument("--seeds", nargs="+", type=int, default=[0, 1], metavar="SEED", help="default: 0 1")
    ask.add_argument(
        "--probes",
        type=positive(int),
        default=20,
        metavar="N",
        help="evaluations of the test views in a run (default 20)",
    )
    ask.add_argument(
        "--out", type=Path, default=Path("outputs/seconds"), metavar="FOLDER",
        help="holds tables and trainings; finished trainings are kept (default: %(default)s)",
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
