"""Measure time, memory and error on this machine. QUESTION names what is measured; QUESTION --help shows its options."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any, Final

import torch

from clear_strategies import console
from clear_strategies.bench.results import Results
from clear_strategies.bench.scenes import NAMES
from clear_strategies.commands import path_of, positive
from clear_strategies.run import program
from rasterizers.interface import PRESETS

Options = Mapping[str, Mapping[str, Any]]
"""The arguments of argparse's `add_argument`, by the flag."""

_COMMON: Final[Options] = {
    "--threads": {"type": positive, "metavar": "N", "help": "threads of torch and the backends"},
    "--out": {"type": path_of, "metavar": "FOLDER", "help": "write tables (CSV), figures (PNG) and the machine here"},
}
_SCENES: Final = f"{', '.join(NAMES)}, or a .ply"
_TURNS: Final[Options] = {
    "--repeats": {"type": positive, "default": 9, "metavar": "N", "help": "turns of each contender (default 9)"},
    "--device": {"default": "cpu", "choices": ["cpu", "cuda"], "help": "default: cpu"},
}
_MANY: Final = {"nargs": "+", "default": []}

QUESTIONS: Final[Mapping[str, tuple[str, Options]]] = {
    "rasterizers": ("time, memory and error of every backend and preset", {
        "--scene": {"nargs": "+", "default": NAMES[1:], "metavar": "SCENE", "help": _SCENES},
        "--backend": {**_MANY, "metavar": "NAME", "help": "default: all that run here"},
        "--preset": {"nargs": "+", "default": list(PRESETS), "choices": list(PRESETS), "help": "default: all"},
        **_TURNS,
    }),
    "iteration": ("time of a training iteration, stage by stage", {
        "--scene": {"default": "s100k", "metavar": "SCENE", "help": f"{_SCENES}; its image is the HR photo"},
        "--backend": {"metavar": "NAME", "help": "default: the fastest that runs here"},
        **_TURNS,
    }),
    "host": ("what the strategies cost in another trainer's loop", {
        "--strategies": {"nargs": "+", "default": ["gco", "p2g", "svs", "clear", "clear skips=none", "best"],
                         "metavar": "NAME", "help": "as in `conductor`, with overrides after a space"},
        "--gaussians": {"type": partial(positive, most=10**9), "default": 46_000, "metavar": "N", "help": "default 46000"},
        "--width": {"type": positive, "default": 128, "metavar": "PX", "help": "of the LR photos (default 128)"},
        **_TURNS, "--repeats": {**_TURNS["--repeats"], "default": 20},
    }),
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the tables and write them."""
    options = vars(parser().parse_args(arguments))
    question, threads = options.pop("question"), options.pop("threads")
    results = Results(options.pop("out"))
    console.show()
    if threads is not None:
        torch.set_num_threads(threads)
    if results.out is not None:  # fails before the measurements if the folder cannot be made
        results.out.mkdir(parents=True, exist_ok=True)
    module = "integration.bench" if question == "host" else f"clear_strategies.bench.{question}"
    import_module(module).measure(results, **options)
    sys.stdout.write(results.text())
    results.write(question, {k: options[k] for k in ("device", "repeats") if k in options})


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(prog="python -m clear_strategies.bench", description=__doc__)
    commands = result.add_subparsers(dest="question", required=True, metavar="QUESTION")
    for question, (what, options) in QUESTIONS.items():
        command = commands.add_parser(question, help=what)
        for flag, keywords in {**_COMMON, **options}.items():
            command.add_argument(flag, **keywords)
    return result


if __name__ == "__main__":
    program(main)
