"""`python -m tests.stress`: every stress measurement whole, and docs/stability.md with what it found.

`--only NAME` runs one of them, `--every N` and `--mutants N` make it smaller; the page says how many cases ran.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from rasterizers.reference import ReferenceRasterizer
from tests.helpers.backends import BACKENDS, why_not
from tests.stress import checkpoints, fuzz, gco, projection
from tests.stress.rows import Row, table

_log = logging.getLogger("tests.stress")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "stability.md"
_CLEAN = {"alpha_min": 1e-7, "transmittance_min": 1e-9}


def drawing() -> Iterator[tuple[str, Callable]]:
    """Every backend that runs here, and how to make it."""
    yield "torch", ReferenceRasterizer
    for name, backend in BACKENDS.items():
        if reason := why_not(name):
            _log.info("%s: left out, %s", name, reason)
        else:
            yield name, backend


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.stress", description=(__doc__ or "").split("\n", maxsplit=1)[0]
    )
    parser.add_argument("--only", choices=("projection", "gco", "checkpoints", "fuzz"), help="one measurement")
    parser.add_argument("--every", type=int, default=1, help="every n-th of the 13,923 single Gaussians (%(default)s)")
    parser.add_argument("--mutants", type=int, default=10**7, help="mutants per format (%(default)s)")
    parser.add_argument("--out", type=Path, default=PAGE, help="the page to write (%(default)s)")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        there = Path(folder)
        for name, run in {
            "projection": lambda: [
                r for n, make in drawing() for r in projection.measure(n, make(**_CLEAN), every=options.every)
            ],
            "gco": gco.measure,
            "checkpoints": lambda: [checkpoints.faults(there / "faults"), checkpoints.integrity(there / "flips", 4000)],
            "fuzz": lambda: fuzz.measure(there, options.mutants),
        }.items():
            if options.only in (None, name):
                _log.info("%s …", name)
                rows += run()
    options.out.write_text(page(rows, f"--every {options.every} --mutants {options.mutants}"))
    _log.info("%s", options.out)
    return int(not all(row.met for row in rows))


def page(rows: list[Row], size: str) -> str:
    """docs/stability.md."""
    return (
        "# Numerical stability\n\n"
        "Extreme inputs, faults and damaged files, and the worst that each did. `python -m tests.stress` measures this page "
        "again; the test command runs a slice of it (`tests/stress/test_stress.py`).\n\n"
        f"Measured on {datetime.datetime.now(datetime.UTC):%Y-%m-%d}, {platform.machine()}, with `{size}`.\n\n"
        + table(rows)
        + "\n"
        "- **Single Gaussians**: 17 scales (1e-8 to 1e8) × 13 depths (1e-6 to 1e6) × 7 logits (-100 to 100) × 9 norms of the "
        "quaternion (1e-20 to 1e20), an ellipsoid drawn by each backend in float32 and by the reference in float64. The "
        "image's error is absolute. The gradient's is relative to the largest attribute's, each gradient times its "
        "parameter.\n"
        "- **GCO** is compared with 60 digits (mpmath), for norms of 1e-36 to 1e36.\n"
        "- **Faults**: every operation on files of a save is made to fail, by a kill, a full disk, an I/O error or a missing "
        "permission.\n"
        "- **Damaged files**: a mutant counts if it is read as a sound file with other content than it may have, if its error "
        "is no `DataError`, or if it takes more than 0.1 s.\n"
    )


if __name__ == "__main__":
    sys.exit(main())
