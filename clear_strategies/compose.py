"""From conf/ to objects: how a configuration is composed, for `run` and for hosts.

conductor("clear", "strategies.gco.tolerance=0.1", iterations=30_000)
"""

from __future__ import annotations

import difflib
import hashlib
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any, Final

import hydra
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from clear_strategies import files
from clear_strategies.errors import SettingError, no_option, of_hydra, one_line
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.detail import DetailRates
from clear_strategies.merging.objective import Objective
from clear_strategies.merging.skips import Skips
from clear_strategies.schedules import REFERENCE_ITERATIONS, scaled
from clear_strategies.settings import (
    CHANGES_NO_RESULT,
    TARGET,
    build,
    defaults_of,
    has_parameter,
    missing,
    with_defaults,
)
from clear_strategies.strategies.base import Strategy

_log = logging.getLogger(__name__)

_PACKAGE: Final = Path(__file__).resolve().parent
# In a wheel conf/ lies inside the package, in a checkout beside it.
CONF: Final = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"

_LONGEST_NAME: Final = 200  # bytes of a folder's name; most file systems take 255

OPTIONS: Final = "clear_strategies_conf"
"""The group of entry points by which other packages bring options, such as strategies; docs/template is such a package."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConductorSettings:
    """What a conductor is made of.

    Args:
        strategies: by the names that the configuration gives them.
        decorators: of the prior, by name; each takes a prior and returns one.
        statistics_from: see `Conductor`; written for 10,000 iterations, as every milestone.
    """

    objective: Objective
    skips: Skips
    strategies: Mapping[str, Strategy] = field(default_factory=dict)
    decorators: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    statistics_from: int | None = signature(Conductor).parameters["statistics_from"].default

    def conductor(self, stretch: float, detail: DetailRates | None = None) -> Conductor:
        """The conductor of a run, its milestones times `stretch`.

        Args:
            detail: for hosts; this package's trainer has the rates of f_det among its own (`optim`).

        Raises:
            StrategyConflict: two strategies answer a question that only one may.
        """
        return Conductor(
            *(scaled(strategy, stretch) for strategy in self.strategies.values()),
            objective=scaled(self.objective, stretch),
            skips=scaled(self.skips, stretch),
            statistics_from=None if self.statistics_from is None else round(self.statistics_from * stretch),
            decorators=tuple(self.decorators.values()),
            detail=detail,
        )


def conductor(
    strategy: str | Sequence[str] = "clear", *overrides: str, iterations: int = REFERENCE_ITERATIONS
) -> Conductor:
    """The strategies of conf/, with their objective and `skips=hosts`, for a host's loop.

    Args:
        strategy: as after `+strategy=`: "clear", "gco", "gco,svs", "[gco,svs]", "baseline" …, or a list, ["gco", "svs"].
        overrides: as on the command line of `run`: "strategies.gco.tolerance=0.1", "objective=paper", "~strategies.p2g".
        iterations: of the host; every milestone stretches from 10,000 to it.

    Raises:
        SettingError: no strategy or field has that name, or a value is outside its range; the message names it.
        StrategyConflict: two strategies answer a question that only one may.
    """
    if iterations < 1:
        raise SettingError(f"iterations must be at least 1, got {iterations}.")
    names = strategy.strip() if isinstance(strategy, str) else f"[{','.join(map(str, strategy))}]"
    chosen = f"+strategy=[{names}]" if "," in names and not names.startswith("[") else f"+strategy={names}"
    config = composed((chosen, *overrides))
    settings: ConductorSettings = build(tree(config, _TRAINERS))
    for name, s in settings.strategies.items():
        if not s.shares_gate:
            raise SettingError(
                f"strategies.{name}: other trainers render both scales with one mask. Leave out shared=false."
            )
    return settings.conductor(iterations / REFERENCE_ITERATIONS, _detail(config).of_run(iterations))


# Options for runs and hosts, such as readings=paper, set these as well; a host has its own, but for the rates of f_det.
_TRAINERS: Final = ("optim", "data")
_READINGS: Final = "readings"


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
    if (absent := next((key for key, value in flat(values).items() if value == "???"), None)) is not None:
        raise missing(absent)
    try:
        values = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    except OmegaConfBaseException as error:
        raise SettingError(one_line(error)) from error
    for name, node in (values.get("strategies") or {}).items():
        if isinstance(node, dict) and node.get(TARGET) is None:
            raise SettingError(
                f"strategies.{name}: has settings ({', '.join(node)}), and takes no part. Add it, +strategy={name}, or leave out "
                "what sets them."
            )
    return {key: _expanded(value) for key, value in values.items() if key not in (_READINGS, *without)}


def _expanded(node: Any) -> Any:
    if isinstance(node, Mapping):
        return {key: _expanded(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_expanded(value) for value in node]
    return files.expanded(node) if isinstance(node, str) else node


def flat(node: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """The leaves of a tree by their dotted keys. The entries of a list that holds tables or lists have their number as key."""
    leaves: dict[str, Any] = {}
    for name, value in node.items():
        nested = isinstance(value, list) and any(isinstance(entry, dict | list) for entry in value)
        below = dict(enumerate(value)) if nested else value
        leaves |= flat(below, f"{prefix}{name}.") if isinstance(below, dict) else {f"{prefix}{name}": value}
    return leaves


def composed(overrides: Sequence[str], config: str = "conductor") -> DictConfig:
    """conf/ with these overrides, from its file `config`: "config" for a run, "conductor" for a host.

    Raises:
        SettingError: an override names nothing, or is no override.
    """
    require_text(overrides)
    # The caller may be a Hydra application, whose state is restored afterwards.
    shared = GlobalHydra.instance()
    before, shared.hydra = shared.hydra, None
    try:
        require_each_once(overrides)
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return hydra.compose(config, list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise not_composed(error, overrides, config) from error
    finally:
        GlobalHydra.instance().hydra = before


_SWEEPS: Final = re.compile(r"\+?(experiment=|strategy=[^\[]*,)")  # overrides by which strategies come later


def not_composed(error: Exception, overrides: Sequence[str], config: str) -> SettingError:
    """The error for overrides that Hydra cannot compose; where there is no such setting, it names the most similar one."""
    # Of a list of options Hydra names the file alone, and not the options that there are.
    if listed := re.search(r"Could not load '(\w+)/([^'/]+)'", str(error)):
        return SettingError(no_option(listed[1], listed[2], [*options(listed[1])]))
    if (unknown := re.match(r"Could not (?:override|delete from config\.) '([^']+)'", str(error))) is None:
        return SettingError(of_hydra(error))
    key = unknown[1]
    if (CONF / key).is_dir():
        return SettingError(f"{key}: no choice of this group is there to be replaced, so it is added: +{key}=….")
    others, group = [o for o in overrides if _key(o) != key], key.partition(".")[0]

    def settings(*chosen: str) -> dict[str, Any]:
        try:
            return OmegaConf.to_container(composed([*others, *chosen], config))  # type: ignore[return-value]
        except SettingError:  # another override is wrong as well
            return {}

    if having := [option for option in options(group) if key in flat(settings(f"{group}={option}"))]:
        train = ", or let the command find it: clear-strategies train FOLDER" if key == "data.path" else ""
        return SettingError(
            f"{key}: there is no such setting without one of {', '.join(f'{group}={o}' for o in having)}. Add it{train}."
        )
    known = settings()
    remedy = "clear-strategies --cfg job prints all of them."
    parent, _, name = key.rpartition(".")
    beside = {".".join(k.split(".")[: key.count(".") + 1]) for k in flat(known) if k.startswith(f"{parent}.")}
    if has_parameter(str(flat(known).get(f"{parent}.{TARGET}")), name):
        remedy = (
            f"Its class has it; a plus adds it: +{key}=…."  # of the user's own class, named by an override or a file
        )
    elif (
        key.startswith("strategies.") and not known
    ):  # the options are in a folder that only Hydra's command line knows
        remedy = f"If its class has it, a plus adds it: +{key}=…."
    elif key.startswith("strategies.") and any(_SWEEPS.match(o) for o in overrides):
        remedy = (
            "Hydra composes a sweep first without what is swept, here the strategies. Sweep this setting, too "
            f"({key}=a,b), or name the strategies that remain (+strategy=[gco,svs])."
        )
    elif name == TARGET:  # of a strategy or a decorator that is new
        remedy = f"A plus adds it: +{key}=…."
    elif f"~{key}" in overrides and beside:
        remedy = f"There are {', '.join(sorted(beside))}."
    elif near := difflib.get_close_matches(key, [name for name in flat(known) if not name.endswith(TARGET)], 1, 0.8):
        remedy = f"Did you mean {near[0]}?"
    elif known and config == "conductor":
        remedy = f"A conductor has settings of {', '.join(known)}."
    return SettingError(f"{key}: there is no such setting. {remedy}")


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def quoted(value: str) -> str:
    """A string of Hydra's grammar: paths may contain spaces, commas, brackets, equals signs and `${`, or look like
    numbers. A backslash is itself, except before a quote or `${`, where both libraries want two.
    """
    if _is_itself(value):
        return value
    for_omegaconf = re.sub(r"(\\*)\$\{", r"\1\1\\${", value)
    for_hydra = re.sub(r"(\\*)('|\Z)", lambda end: end[1] * 2 + ("\\'" if end[2] else ""), for_omegaconf)
    return f"'{for_hydra}'"


def _is_itself(value: str) -> bool:
    """Whether Hydra and OmegaConf read the unquoted value as this string."""
    try:
        parsed = OverridesParser.create().parse_override(f"key={value}")
    except HydraException:
        return False
    return not parsed.is_sweep_override() and parsed.value() == value and not set("$\\") & set(value)


def require_text(overrides: Iterable[object]) -> None:
    """Raise a SettingError for an override that is no text, such as a list of them, as Python's callers may give."""
    for override in overrides:
        if not isinstance(override, str):
            rule = f"overrides: must be given one by one, each as text, got {override!r}"
            raise SettingError(f'{rule}. Write "skips=none", "objective=paper", or a list with a star: *overrides.')


def require_each_once(overrides: Iterable[str]) -> None:
    """Raise a SettingError for a strategy that is named twice, since Hydra merges the two into one silently, and for what is no
    name. Warn of the strategies that a method sets aside.
    """
    before = list[str]()
    for override in OverridesParser.create().parse_overrides(list(overrides)):
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
        strategies = Counter(strategy for option in options for strategy in _strategies_of(option))
        if twice := next((strategy for strategy, count in strategies.items() if count > 1), None):
            raise SettingError(f"+strategy: must name each strategy once, got {twice} twice in {override.input_line}.")


def _strategies_of(option: str) -> list[str]:
    """The strategies that an option of conf/strategy consists of, those of the options that it names included."""
    file = CONF / "strategy" / f"{option}.yaml"
    content: Any = OmegaConf.to_container(OmegaConf.load(file)) if file.is_file() else {}
    parts = [part for part in content.get("defaults", []) if isinstance(part, str) and not part.startswith(("/", "_"))]
    return [strategy for part in parts for strategy in _strategies_of(part)] or [option]


def options(group: str) -> dict[str, Mapping[str, Any]]:
    """The content of each file in a group of conf/ and of the folders that other packages bring, by its name."""
    folders = (CONF, *(Path(_folder_of(point)) for point in entry_points(group=OPTIONS)))
    files = [file for folder in folders for file in sorted((folder / group).glob("[!_]*.yaml"))]
    return {file.stem: OmegaConf.to_container(OmegaConf.load(file)) for file in files}  # type: ignore[misc]


class _ConfSource(FileConfigSource):
    """The files of conf/, each node with a `_target_` filled with the defaults of what it names."""

    @staticmethod
    def scheme() -> str:
        return "clear"

    def load_config(self, config_path: str) -> ConfigResult:
        result = super().load_config(config_path)
        result.config = OmegaConf.create(with_defaults(OmegaConf.to_container(result.config)))
        return result


class _ReadConf(SearchPathPlugin):
    """Makes Hydra read conf/, and after it the folders that other packages bring, by `_ConfSource`."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        conf = [e for e in search_path.get_path() if e.path is not None and e.path.removeprefix("file://") == str(CONF)]
        for element in conf:
            element.path = f"{_ConfSource.scheme()}://{CONF}"
        for point in entry_points(group=OPTIONS) if conf else ():
            search_path.append(point.name, f"{_ConfSource.scheme()}://{_folder_of(point)}")


def _folder_of(point: EntryPoint) -> str:
    """The folder of the package that an entry point of `OPTIONS` names; a SettingError where there is none."""
    try:
        spec = find_spec(point.value)
    except ModuleNotFoundError:  # the package that it lies in
        spec = None
    if spec is None or not spec.submodule_search_locations:
        raise SettingError(
            f"the entry point {point.name} = {point.value!r} of {OPTIONS!r} must name a package, and there is none of this "
            f"name. Mend or remove the package that brings it: pip show -f {point.dist.name if point.dist else point.name}."
        )
    return str(next(iter(spec.submodule_search_locations)))


def _one_folder(name: str) -> str:
    """`${one_folder:name}` in conf/: the name of a job's folder, one word that every file system takes. A path among the
    overrides would otherwise lead elsewhere: behind `../..` all jobs share a folder.
    """
    word = name.replace("/", "_")
    if len(word.encode()) <= _LONGEST_NAME:
        return word
    digest = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{word.encode()[: _LONGEST_NAME - len(digest) - 1].decode(errors='ignore')}_{digest}"


def _reading(*, _node_: Any, _root_: Any) -> Any:
    """`${reading:}` in conf/strategy: what readings= says of this setting, else the default of the class.

    So readings of strategies that take no part have no effect, whatever the order of the options.
    """
    _, strategy, *field = _node_._get_full_key(None).split(".")
    read = OmegaConf.select(_root_, ".".join((_READINGS, strategy, *field)))
    return defaults_of(_root_.strategies[strategy][TARGET], *field) if read is None else read


# `${settings_without_result:more, …}` in conf/: the keys of overrides that do not name a sweep's folders.
OmegaConf.register_new_resolver(
    "settings_without_result", lambda *more: [*sorted(CHANGES_NO_RESULT), *more], replace=True
)
OmegaConf.register_new_resolver("one_folder", _one_folder, replace=True)
OmegaConf.register_new_resolver("reading", _reading, replace=True)
Plugins.instance().register(_ConfSource)
Plugins.instance().register(_ReadConf)
