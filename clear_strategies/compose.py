"""From conf/ to objects: the one place that turns Hydra's nodes into what they name, for `run` and for hosts.

conductor("clear", "strategies.gco.tolerance=0.1", iterations=30_000)
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from clear_strategies.errors import ClearError, DataError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.schedules import REFERENCE_ITERATIONS, scaled
from clear_strategies.strategies.base import Strategy

_PACKAGE: Final = Path(__file__).resolve().parent
# In a wheel conf/ lies inside the package, in a checkout beside it.
CONF: Final = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"


def conductor(strategy: str = "clear", *overrides: str, iterations: int = REFERENCE_ITERATIONS) -> Conductor:
    """The strategies of conf/, with their objective, for a host's loop.

    Args:
        strategy: as after `+strategy=`: "clear", "gco", "gco,svs", "baseline" …
        overrides: as on the command line of `run`: "strategies.gco.tolerance=0.1", "objective=paper", "~strategies.p2g".
        iterations: of the host; every milestone stretches from 10,000 to it.

    Raises:
        DataError: no strategy or field has that name, or a value is outside its range; the message names it.
        StrategyConflict: two strategies answer a question that only one may.
    """
    if iterations < 1:
        raise ValueError(f"iterations must be at least 1, got {iterations}.")
    names = [name.strip() for name in strategy.split(",")]
    said = [f"+strategy=[{','.join(names)}]" if len(names) > 1 else f"+strategy={names[0]}", *overrides]
    return build_conductor(_compose(said), iterations / REFERENCE_ITERATIONS)


def build_conductor(config: DictConfig, stretch: float) -> Conductor:
    """The conductor of a composed configuration, its milestones times `stretch`."""
    return Conductor(
        *(scaled(s, stretch) for s in strategies(config)),
        objective=scaled(instantiate(config.objective, "objective"), stretch),
        statistics_from=round(config.statistics_from * stretch),
    )


def _compose(overrides: list[str]) -> DictConfig:
    # Who calls may be a Hydra application: its own is put back.
    shared = GlobalHydra.instance()
    theirs, shared.hydra = shared.hydra, None
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return hydra.compose("config", overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise DataError("config", " ".join(overrides), one_line(error), "see conf/ for what there is") from error
    finally:
        GlobalHydra.instance().hydra = theirs


def instantiate(config: Any, key: str, **extra: Any) -> Any:
    """Build what a config node names, with errors that name the node."""
    try:
        return hydra.utils.instantiate(config, _convert_="object", **extra)
    except InstantiationException as error:
        cause = error.__cause__
        if isinstance(cause, ClearError):
            raise cause from None
        raise DataError("config", key, one_line(cause or error), "see the field's comment in conf/") from cause


def strategies(config: DictConfig) -> Iterator[Strategy]:
    """Those under `strategies`, in the order of their composition.

    Raises:
        DataError: something else than a strategy stands there.
    """
    for name, node in config.strategies.items():
        strategy = instantiate(node, f"strategies.{name}")
        if not isinstance(strategy, Strategy):
            raise DataError(
                "config", f"strategies.{name}", f"is a {type(strategy).__name__}, not a Strategy",
                "derive the class from clear_strategies.Strategy",
            )  # fmt: skip
        yield strategy


def plain(node: Any) -> dict[str, Any]:
    """A node as a dict of ordinary values."""
    found = OmegaConf.to_container(node, resolve=True)
    return {str(k): v for k, v in found.items()} if isinstance(found, dict) else {}


def one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
