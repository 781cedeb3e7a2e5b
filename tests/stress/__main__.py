"""`python -m tests.stress`: every stress measurement whole, and docs/stability.md with what it found.

`--only NAME …` measures some of them and keeps the other rows of docs/stability.csv. Options make the longest smaller; the
page says how many cases ran, and with how many a release is measured. Each row is written when it is there, so that what is
interrupted keeps what it has measured.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import platform
import sys
import tempfile
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from clear_strategies import files
from tests.helpers.backends import CLEAN, EVERY, why_not
from tests.stress import (
    attacks,
    bad_inputs,
    checkpoints,
    faults,
    fuzz,
    gco,
    kills,
    lifecycle,
    memory,
    projection,
    rows,
    sanitizers,
    soak,
)
from tests.stress.rows import Row

_log = logging.getLogger("tests.stress")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "stability.md"
_DAMAGED = {fuzz.binary: 1, fuzz.text: 20, fuzz.scenes: 200}  # of a text file or a scene, that many times fewer mutants


def _projection(options: argparse.Namespace, _: Path) -> Iterator[Row]:
    reasons = {name: why_not(name) for name in EVERY}
    for name, reason in reasons.items():
        if reason:
            _log.info("%s: left out, %s", name, reason)
    drawing = {name: make(**CLEAN) for name, make in EVERY.items() if not reasons[name]}
    return projection.measure(drawing, every=options.every)


def _fuzz(options: argparse.Namespace, _: Path) -> Iterator[Row]:
    for targets, fewer in _DAMAGED.items():
        count, goal = max(1, options.mutants // fewer), 10**7 // fewer
        only = [name for name in fuzz.names(targets) if options.formats is None or name in options.formats]
        yield from fuzz.measure(targets, count, only=only, goal=goal, processes=options.processes)


def _sanitizers(options: argparse.Namespace, folder: Path) -> Iterable[Row]:
    if reason := sanitizers.why_not():
        _log.info("sanitizers: left out, %s", reason)
        return []
    return sanitizers.measure(folder, options.isa)


MEASUREMENTS: dict[str, Callable[[argparse.Namespace, Path], Iterable[Row]]] = {
    "projection": _projection,
    "gco": lambda options, folder: gco.measure(),
    "lifecycle": lambda options, folder: [lifecycle.measure(options.examples)],
    "faults": lambda options, folder: [faults.measure(folder)],
    "kills": lambda options, folder: [kills.measure(folder, options.kills)],
    "integrity": lambda options, folder: [checkpoints.integrity(folder, 4000)],
    "inputs": lambda options, folder: bad_inputs.measure(folder),
    "attacks": lambda options, folder: [attacks.measure(folder)],
    "fuzz": _fuzz,
    "memory": lambda options, folder: memory.measure(),
    "soak": lambda options, folder: soak.measure(options.iterations),
    "sanitizers": _sanitizers,
}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.stress", description=(__doc__ or "").split("\n", maxsplit=1)[0]
    )
    parser.add_argument("--only", nargs="+", choices=MEASUREMENTS, default=list(MEASUREMENTS), help="some of them")
    parser.add_argument("--every", type=int, default=1, help="every n-th of the 13,923 single Gaussians (%(default)s)")
    parser.add_argument("--mutants", type=int, default=10**7, help="mutants per binary format (%(default)s)")
    formats = [name for targets in _DAMAGED for name in fuzz.names(targets)]
    parser.add_argument("--formats", nargs="+", choices=formats, help="of damaged files (all)")
    parser.add_argument("--processes", type=int, default=1, help="that share the mutants (%(default)s)")
    parser.add_argument("--examples", type=int, default=500, help="runs in random order (%(default)s)")
    parser.add_argument("--kills", type=int, default=200, help="SIGKILLs of a run (%(default)s)")
    parser.add_argument("--iterations", type=int, default=10_000, help="of the soak (%(default)s)")
    parser.add_argument("--isa", nargs="+", help="instruction sets for the sanitizers (all that run here)")
    parser.add_argument("--list", action="store_true", help="name every bad input and attack, and measure nothing")
    parser.add_argument(
        "--out", type=Path, default=PAGE, help="the page to write, with its .csv beside it (%(default)s)"
    )
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if options.list:
        given = [*bad_inputs.inputs(), *attacks.attacks()]
        sys.stdout.write("".join(f"{one.id}\n" for one in given))
        return 0
    found = list[Row]()
    with tempfile.TemporaryDirectory() as folder:
        for name in (name for name in MEASUREMENTS if name in options.only):
            _log.info("%s …", name)
            there = Path(folder) / name
            there.mkdir()
            for row in MEASUREMENTS[name](options, there):
                day = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}"
                found.append(replace(row, part=name, measured=day))
                _write(options.out, found)
            if name != "fuzz" or options.formats is None:
                _write(options.out, found, whole={name})
    _log.info("%s", options.out)
    return int(not all(row.met for row in found))


def _write(out: Path, found: list[Row], whole: Container[str] = ()) -> None:
    csv = out.with_suffix(".csv")
    rows.write(csv, rows.merged(rows.read(csv), found, list(MEASUREMENTS), whole))
    files.write_text(out, page(rows.read(csv)))


def page(found: list[Row]) -> str:
    """docs/stability.md."""
    return (
        "# Numerical stability\n\n"
        "Extreme inputs, faults, kills and damaged files, and the worst that each did. `python -m tests.stress` measures this "
        "page again, `python -m tests.stress --only soak` one part of it; the test command runs a slice "
        "(`tests/stress/test_stress.py`).\n\n"
        f'Measured on {platform.machine()}. "Goal" is the number of cases that a release is measured with: where fewer ran, '
        'a bound that holds is met "so far". The numbers are in [stability.csv](stability.csv).\n\n'
        + rows.table(found)
        + "\n"
        "- **Single Gaussians**: 17 scales (1e-8 to 1e8) × 13 depths (1e-6 to 1e6) × 7 logits (-100 to 100) × 9 norms of the "
        "quaternion (1e-20 to 1e20), an ellipsoid drawn by each backend in float32 and by the reference in float64. The "
        "image's error is absolute. The gradient's is relative to the largest attribute's, each gradient times its "
        "parameter.\n"
        "- **GCO** is compared with 60 digits (mpmath), for norms of 1e-36 to 1e36.\n"
        "- **Lifecycle**: a run that steps, densifies, prunes, resets, saves, resumes and gets NaN in any order. After each of "
        "these all rows belong together, every number is finite and in range, and a refused step has changed nothing.\n"
        "- **Fault points**: every operation on files of a save, an export and a resumed run is made to fail, by a kill, a full "
        "disk, an I/O error, a missing permission or a write cut short. Afterwards a checkpoint loads, every other file is the "
        "old or the new one, and the next start leaves no rest.\n"
        "- **SIGKILLs**: a small run is killed at random moments and started again until it ends, then compared bit for bit "
        "with one that nobody killed.\n"
        "- **Bad inputs and attacks** are tables with a name for each (`python -m tests.stress --list`). An attack must also "
        "start no program, open no connection, and open no file outside its folder.\n"
        "- **Damaged files**: one to three edits each. A mutant counts if it is read as a sound file with other content than it "
        "may have, if its error is no `DataError`, or if it takes more than 0.1 s or 1 GiB. Each file is read by its own "
        "reader; a *scene* is read as a whole, with one of its files damaged. Tensors *with their hash* are what a program that "
        "also writes the manifest could leave. `--processes` spreads the mutants, which are the same in any number of them.\n"
        "- **Memory**: the peak that the plan predicts, at the number of Gaussians that the run reached, against what the "
        "process took beyond its imports. The rest is what the C library has freed and keeps. What an iteration holds per pixel "
        "was counted with these scenes at hand.\n"
        "- **Soak**: one process, with evaluations and checkpoints on the way.\n"
        "- **C++ under ASan and UBSan** (`--only sanitizers`): the modules compiled anew with both sanitizers, and their tests. "
        "Without rows above it has not been run since the page began.\n"
    )


if __name__ == "__main__":
    sys.exit(main())
