"""`python -m tests.stress`: every stress measurement whole, and docs/stability.md with what it found.

`--only NAME …` measures some of them and keeps the other rows of docs/stability.csv. Options make the longest smaller; the
page says how many cases ran, and with how many a release is measured. Each row is written as soon as it is measured, so that
an interrupted command keeps its rows.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import platform
import re
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
        sys.stdout.write("".join(f"{given.id}\n" for given in (*bad_inputs.inputs(), *attacks.attacks())))
        return 0
    measured = list[Row]()
    with tempfile.TemporaryDirectory() as folder:
        for name in (name for name in MEASUREMENTS if name in options.only):
            _log.info("%s …", name)
            part_folder = Path(folder) / name
            part_folder.mkdir()
            for row in MEASUREMENTS[name](options, part_folder):
                day = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}"
                measured.append(replace(row, part=name, measured=day))
                _write(options.out, measured)
            if name != "fuzz" or options.formats is None:
                _write(options.out, measured, whole={name})
    _log.info("%s", options.out)
    return int(not all(row.met for row in measured))


def _write(out: Path, measured: list[Row], whole: Container[str] = ()) -> None:
    """Write the CSV file, and docs/stability.md with its rows as the table; the page's words stay."""
    csv = out.with_suffix(".csv")
    rows.write(csv, rows.merged(rows.read(csv), measured, list(MEASUREMENTS), whole))
    words = re.sub(r"Measured on \w+\.", f"Measured on {platform.machine()}.", PAGE.read_text(encoding="utf-8"))
    table = rows.table(rows.read(csv))
    files.write_text(out, re.sub(r"(^\|.*\n)+", lambda _: table, words, count=1, flags=re.MULTILINE))


if __name__ == "__main__":
    sys.exit(main())
