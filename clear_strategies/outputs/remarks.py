"""What a finished run has shown of its strategies, a line each."""

from __future__ import annotations

import math
from collections import defaultdict

from clear_strategies.training.state import TrainState


def remarks(state: TrainState) -> list[str]:
    """What each strategy says of the means of the run's history; see `Strategy.in_hindsight`."""
    columns: defaultdict[str, list[float]] = defaultdict(list)
    for row in state.history_as_floats():
        for name, value in row.items():
            if not math.isnan(value):
                columns[name].append(value)
    means = {name: sum(values) / len(values) for name, values in columns.items()}
    said = (strategy.in_hindsight(means) for strategy in state.conductor.strategies)
    return [remark for remark in said if remark is not None]
