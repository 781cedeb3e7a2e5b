"""From conf/ to objects: how a configuration is composed, for `run` and for hosts.

conductor("clear", "strategies.gco.tolerance=0.1", iterations=30_000)
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from inspect import signature
from typing import Any, Final

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from clear_strategies import files
from clear_strategies.errors import SettingError, one_line
from clear_strategies.hydra_errors import NOT_COMPOSED, not_composed, require_option
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.detail import DetailRates
from clear_strategies.merging.objective import Objective
from clear_strategies.merging.skips import Skips
from clear_strategies.options import READINGS, composed_by_hydra, strategies_of
from clear_strategies.schedules import REFERENCE_ITERATIONS, scaled
from clear_strategies.settings import TARGET, absent, build, missing
from clear_strategies.strategies.base import Strategy

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ConductorSettings:
    """Settings of a conductor.

    Args:
        strategies: the strategies, by the names that the configuration gives them.
        decorators: functions that take a prior and return one, by name, such as back_projected.
        statistics_from: the iteration from which densification reads the HR render, a milestone; see `Conductor`.
    """

    objective: Objective
    skips: Skips
    strategies: Mapping[str, Strategy] = field(default_factory=dict)
    decorators: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    statistics_from: int | None = signature(Conductor).parameters["statistics_from"].default

    def conductor(self, stretch: float, detail: DetailRates | None = None, own: Sequence[Strategy] = ()) -> Conductor:
        """The conductor of a run, its milestones times `stretch`.

        Args:
            detail: for hosts; this package's trainer has the rates of f_det among its own (`optim`).
            own: further strategies, used as they are.

        Raises:
            StrategyConflict: two strategies answer a question that only one may.
        """
        return Conductor(
            *(scaled(strategy, stretch) for strategy in self.strategies.values()),
            *own,
            objective=scaled(self.objective, stretch),
            skips=scaled(self.skips, stretch),
            statistics_from=None if self.statistics_from is None else round(self.statistics_from * stretch),
            decorators=tuple(self.decorators.values()),
            detail=detail,
        )


def conductor(
    strategy: str | Sequence[str] = "clear", *more: str | Strategy, iterations: int = REFERENCE_ITERATIONS
) -> Conductor:
    """The strategies of conf/, with their objective and `skips=hosts`, for a host's loop.

    `best` leaves out `mcmc` and `random_background` here, unless `strategy` or an override names them.

    Args:
        strategy: as after `+strategy=`: "clear", "gco", "gco,svs", "[gco,svs]", "baseline" …, or a list, ["gco", "svs"].
        more: overrides, as on the command line of `run`: "strategies.gco.tolerance=0.1", "objective=paper", "~strategies.p2g";
            and strategies of your own, whose milestones are iterations of the host.
        iterations: of the host; every other milestone stretches from 10,000 to it.

    Raises:
        SettingError: no strategy or field has that name, or a value is outside its range; the message names it.
        StrategyConflict: two strategies answer a question that only one may.
    """
    if iterations < 1:
        raise SettingError(f"iterations must be at least 1, got {iterations}.")
    names = strategy.strip() if isinstance(strategy, str) else f"[{','.join(map(str, strategy))}]"
    chosen = f"+strategy=[{names}]" if "," in names and not names.startswith("[") else f"+strategy={names}"
    own = [s for s in more if isinstance(s, Strategy)]
    overrides: Any = [word for word in more if not isinstance(word, Strategy)]  # text, as `composed` requires
    config = composed((chosen, *overrides))
    content = tree(config, _TRAINERS)
    for part, reason in _NOT_IN_HOSTS.items():
        is_named = any(part in word for word in (names, *overrides))
        if not is_named and content["strategies"].pop(part, None) is not None:
            _say_left_out(part, reason)
    settings: ConductorSettings = build(content)
    return settings.conductor(iterations / REFERENCE_ITERATIONS, _detail(config).of_run(iterations), own)


# Parts of `best`. Without `mcmc`, random backgrounds gain nothing on fern and horns, and cost 0.4 dB on the demo.
_NOT_IN_HOSTS: Final = {
    "mcmc": "other trainers keep their own density control",
    "random_background": "in other trainers it gains nothing, or costs PSNR. It is used if it is named, as by "
    "strategies.random_background.until=9000",
}


@cache  # launchers compose twice
def _say_left_out(part: str, reason: str) -> None:
    _log.info("%s is left out: %s.", part, reason)


# Options for runs and hosts, such as readings=paper, set these as well; a host has its own, but for the rates of f_det.
_TRAINERS: Final = ("optim", "data")


def _detail(config: DictConfig) -> DetailRates:
    """The rates of f_det that an option has set, else the defaults."""
    optim = OmegaConf.to_container(config.get("optim", OmegaConf.create()))
    keys = {"detail": "rate", "detail_steps": "steps", "detail_decay": "decay"}
    return DetailRates(**{keys[key]: value for key, value in optim.items() if key in keys})  # type: ignore[union-attr]


def tree(config: DictConfig, without: Iterable[str] = ()) -> dict[str, Any]:
    """A composed configuration as plain values, interpolations resolved, paths with `~` expanded.

    Raises:
        SettingError: an interpolation leads to nothing, or to a value that is missing.
    """
    values: dict[str, Any] = OmegaConf.to_container(config)  # type: ignore[assignment]
    if (key := absent(values)) is not None:
        raise missing(key)
    try:
        values = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    except OmegaConfBaseException as error:
        raise SettingError(one_line(error)) from error
    strategies = values.get("strategies")
    for name, node in strategies.items() if isinstance(strategies, dict) else ():
        if isinstance(node, dict) and node.get(TARGET) is None:
            raise SettingError(
                f"strategies.{name}: has settings ({', '.join(node)}), and takes no part. Add it, +strategy={name}, or leave out "
                "what sets them."
            )
    return {key: _expanded(value) for key, value in values.items() if key not in (READINGS, *without)}


def _expanded(node: Any) -> Any:
    if isinstance(node, Mapping):
        return {key: _expanded(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_expanded(value) for value in node]
    return files.expanded(node) if isinstance(node, str) else node


def composed(overrides: Sequence[str], config: str = "conductor") -> DictConfig:
    """conf/ with these overrides, from its file `config`: "config" for a run, "conductor" for a host.

    Raises:
        SettingError: an override names nothing, or is no override.
    """
    require_text(overrides)
    try:
        require_each_once(overrides)
        return composed_by_hydra(overrides, config)
    except NOT_COMPOSED as error:
        raise not_composed(error, overrides, config) from error


def quoted(value: str) -> str:
    """A string of Hydra's grammar: paths may contain spaces, commas, brackets, equals signs and `${`, or look like
    numbers. A backslash is itself, except before a quote or `${`, where both libraries want two.
    """
    with suppress(HydraException):
        parsed = OverridesParser.create().parse_override(f"key={value}")
        if not parsed.is_sweep_override() and parsed.value() == value and not set("$\\") & set(value):
            return value  # as it is, both libraries read this string
    for_omegaconf = re.sub(r"(\\*)\$\{", r"\1\1\\${", value)
    for_hydra = re.sub(r"(\\*)('|\Z)", lambda end: end[1] * 2 + ("\\'" if end[2] else ""), for_omegaconf)
    return f"'{for_hydra}'"


def require_text(overrides: Iterable[object]) -> None:
    """Raise a SettingError for an override that is no text, such as a list of them, as Python's callers may give."""
    for override in overrides:
        if not isinstance(override, str):
            rule = f"overrides: must be given one by one, each as text, got {override!r}"
            raise SettingError(f'{rule}. Write "skips=none", "objective=paper", or a list with a star: *overrides.')


def require_each_once(overrides: Iterable[str]) -> None:
    """Raise a SettingError for a strategy that is named twice, since Hydra merges the two into one silently, for what is no name,
    and for a claim before the strategies, whose options would replace it. Warn of the strategies that a method sets aside.
    """
    before, claim = list[str](), ""
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        require_option(override)
        if override.key_or_group == "claim":
            claim = str(override.input_line)
        if override.key_or_group in ("strategy", "method") and claim:
            rule = f"{claim}: must stand behind the strategies that it changes, got it before {override.input_line}"
            raise SettingError(f"{rule}. Write {override.input_line} {claim}.")
        if override.key_or_group == "method" and before and override.value():
            message = "%s has no effect: %s replaces the strategies before it. What is written behind the method is added to it."
            _log.warning(message, " ".join(before), override.input_line)
        if override.key_or_group != "strategy" or override.is_sweep_override():
            continue
        value = override.value()
        if value != "baseline":  # no strategy
            before.append(str(override.input_line))
        named = value if isinstance(value, list) else [value]
        options = [option for option in named if isinstance(option, str)]
        if len(options) < len(named):  # else Hydra raises errors of Python's
            rule = f"+strategy: must be a name or a list of names, got {override.input_line}"
            raise SettingError(f"{rule}. Write +strategy=gco or +strategy=[gco,svs].")
        strategies = Counter(strategy for option in options for strategy in strategies_of(option))
        if twice := next((strategy for strategy, count in strategies.items() if count > 1), None):
            raise SettingError(f"+strategy: must name each strategy once, got {twice} twice in {override.input_line}.")
