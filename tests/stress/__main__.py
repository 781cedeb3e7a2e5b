"""`python -m tests.stress`: every stress measurement whole, printed as the table of docs/stability.md.

`--only NAME …` measures some of them; `--share 0.01` takes that part of the cases where their number is free.
"""

import argparse
import logging
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from tests.helpers.backends import CLEAN, EVERY, why_not
from tests.stress import bad_inputs, faults, fuzz, gco, kills, lifecycle, projection, soak
from tests.stress.rows import HEADER, Row

_log = logging.getLogger("tests.stress")
_MUTANTS = {fuzz.binary: 10**7, fuzz.text: 500_000, fuzz.scenes: 50_000}  # of each file


def _projection(share: float, _: Path) -> Iterator[Row]:
    reasons = {name: why_not(name) for name in EVERY}
    for name, reason in reasons.items():
        if reason:
            _log.info("%s: left out, %s", name, reason)
    drawing = {name: make(**CLEAN) for name, make in EVERY.items() if not reasons[name]}
    return projection.measure(drawing, every=round(1 / share))


MEASUREMENTS: dict[str, Callable[[float, Path], Iterable[Row]]] = {
    "projection": _projection,
    "gco": lambda share, folder: gco.measure(),
    "lifecycle": lambda share, folder: [lifecycle.measure(round(500 * share))],
    "faults": lambda share, folder: [faults.measure(folder)],
    "kills": lambda share, folder: [kills.measure(folder, round(200 * share))],
    "integrity": lambda share, folder: [faults.integrity(folder, round(100_000 * share))],
    "inputs": lambda share, folder: [bad_inputs.measure(folder)],
    "fuzz": lambda share, folder: [fuzz.measure(targets, round(n * share)) for targets, n in _MUTANTS.items()],
    "soak": lambda share, folder: soak.measure(round(10_000 * share)),
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.stress", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=MEASUREMENTS, default=list(MEASUREMENTS), help="some of them")
    parser.add_argument("--share", type=float, default=1.0, help="of the cases (%(default)s)")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    sys.stdout.write(f"{HEADER}\n")
    met = True
    for name in options.only:
        _log.info("%s …", name)
        with tempfile.TemporaryDirectory() as folder:
            for row in MEASUREMENTS[name](options.share, Path(folder)):
                sys.stdout.write(f"{row}\n")
                sys.stdout.flush()
                met &= row.met
    return int(not met)


if __name__ == "__main__":
    sys.exit(main())
