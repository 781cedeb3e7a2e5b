"""Hydra's errors in words that name our commands and settings."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from clear_strategies.errors import SettingError, one_line
from clear_strategies.options import CONF, composed_by_hydra, has_setting, malformed, options, sweeps
from clear_strategies.settings import TARGET, flat, has_parameter, key_of

NOT_COMPOSED: Final = (HydraException, OmegaConfBaseException, YAMLError)
"""What composing a configuration raises where an override or a file of options is wrong."""
WRITTEN: Final = "A setting is written name=value, and clear-strategies --cfg job prints all of them."
# What Hydra says, and what to say in place of it. Packages hydra-NAME-launcher bring launchers.
_IN_OUR_WORDS: Final = {
    r"Could not (?:load|find) 'hydra/launcher/((joblib|submitit|ray)(?:_local|_slurm|_aws)?)'": (
        "hydra/launcher: {} is not installed: pip install hydra-{}-launcher."
    ),
    r"^LexerNoViableAltException: ([+~]*[\w./@]+)=(.+) \^ ": (
        "{0}: its value {1} cannot be read. Quotation marks come in pairs, and special characters within them: '{0}=\"…\"'."
    ),
    r"^(?:Error parsing override '|LexerNoViableAltException: )(.+?)(?:' missing EQUAL| \^ )": (
        f"{{}}: is no setting. {WRITTEN}"
    ),
    r"^Multiple values for (\S+)\. To override a value use 'override \S+: (\S+)'$": (
        "+{0}={1}: a choice of this group is there already. Replace it: {0}={1}."
    ),
    r"^Ambiguous value for argument '(.+?)=(.+)' 1\. ": (
        "{0}: {1} is several values. -m trains a run with each, and brackets make them one list: '{0}=[{1}]'."
    ),
}
_SWEEPS: Final = re.compile(r"\+?(experiment=|strategy=[^\[]*,)")  # overrides by which strategies come later


def require_option(override: Override) -> None:
    """Raise a SettingError for an override that has no name or chooses nothing of a group of conf/, which are bare errors of
    Python's in Hydra, or for several experiments of which one sweeps.
    """
    chosen, group = override.value(), override.key_or_group
    if not group:
        raise SettingError(f"{override.input_line}: names no setting. {WRITTEN}")
    each = chosen.list if isinstance(chosen, ChoiceSweep) else [chosen]
    nothing = [name for name in each if not name and not (override.is_add() and name == [])]  # +method=srgs,[]: a row
    if nothing and not override.is_delete() and (CONF / group).is_dir():
        told = "null" if None in each else (override.input_line or "").partition("=")[2]
        raise SettingError(no_option(group, told, [*options(group)]))
    if group == "experiment" and len(each) > 1 and any(isinstance(name, str) and sweeps(name) for name in each):
        alone = ", ".join(f"experiment={name}" for name in each)
        raise SettingError(
            f"{override.input_line}: an experiment that sweeps settings of its own runs alone. Start each by itself: {alone}."
        )


def no_option(group: str, name: object, listed: Sequence[str], config: str = "config") -> str:
    """The message for an option that a group of conf/ does not have: the nearest one, or the group that has this name."""
    base: Any = OmegaConf.load(CONF / f"{config}.yaml")
    chosen = {key for entry in base.defaults if entry != "_self_" for key in entry}
    groups = sorted(folder.name for folder in CONF.iterdir() if (folder / f"{name}.yaml").is_file())
    if config == "conductor":  # a host has no method, and no scene
        groups = [other for other in groups if other in chosen]
    near = [f"{'' if other in chosen else '+'}{other}={name}" for other in groups]
    near += difflib.get_close_matches(str(name), listed, 1)
    several = re.split(r"[+ ]+", str(name))  # as the title of a run has them
    if group == "strategy" and {*several} <= {*listed}:
        near = [f"'+strategy=[{','.join(several)}]'"]
    suggestion = f" Did you mean {' or '.join(near)}?" if near else ""
    return f"{group}={name}: there is no such option.{suggestion} There are {', '.join(listed)}."


def not_composed(error: Exception, overrides: Sequence[str], config: str) -> SettingError:
    """The error for overrides that Hydra cannot compose, in one line; where there is no such setting or option, it names the most
    similar one.

    Args:
        config: as of `compose.composed`.
    """
    text = one_line(error)
    if isinstance(error, YAMLError):
        return malformed(error)
    for theirs, ours in _IN_OUR_WORDS.items():
        if said := re.search(theirs, text):
            return SettingError(ours.format(*said.groups()))
    if said := re.search(
        r"Could not find '([^']+)/([^'/]*)' Available options in '[^']*':(.*?)Config search path", text
    ):
        group, name, listed = said.groups()
        known = [option for option in listed.split() if not option.startswith("_")]
        return SettingError(no_option(group, name, known, config))
    # Of a list of options Hydra names the file alone, and not the options that there are.
    if said := re.search(r"Could not load '(\w+)/([^']+)'", text):
        return SettingError(no_option(said[1], said[2], [*options(said[1])], config))
    if said := re.match(r"Could not (?:override|delete from config\.) '([^']+)'", text):
        return SettingError(f"{said[1]}: {_no_setting(said[1], overrides, config)}")
    return SettingError(text)


def _no_setting(key: str, overrides: Sequence[str], config: str) -> str:
    """What to say of a setting that is not there."""
    value = next((o.partition("=")[2] for o in overrides if key_of(o) == key), "")
    if (CONF / key).is_dir():
        return f"no choice of this group is there to be replaced, so it is added: +{key}={value or '…'}."
    others, group = [o for o in overrides if key_of(o) != key], key.partition(".")[0]
    own = f"{key.rpartition('.')[0]}.{TARGET}" in map(key_of, overrides)  # a class of the user's in place of an option
    for choice in () if own else (group, *["protocol"] * (group == "data")):  # a protocol's scenes have data.root
        plus = "+" * (choice == "protocol")
        having = [f"{plus}{choice}={option}" for option in options(choice) if has_setting(choice, option, key)]
        if having and key in flat(_composed([*others, having[0]], config)):  # else another of the group is chosen
            train = ", or let the command find it: clear-strategies train FOLDER" if key == "data.path" else ""
            return f"there is no such setting without one of {', '.join(having)}. Add it{train}."
    return f"there is no such setting. {_remedy(key, value, overrides, _composed(others, config), config)}"


def _composed(overrides: Sequence[str], config: str) -> dict[str, Any]:
    """The settings of overrides but for what is swept, none if another one is wrong as well."""
    try:
        words = OverridesParser.create().parse_overrides(list(overrides))
        fixed = [text for text, word in zip(overrides, words, strict=True) if not word.is_sweep_override()]
        return OmegaConf.to_container(composed_by_hydra(fixed, config))  # type: ignore[return-value]
    except NOT_COMPOSED:
        return {}


def _remedy(key: str, value: str, overrides: Sequence[str], known: Mapping[str, Any], config: str) -> str:
    """What to write in place of an unknown setting; `known` are the settings of the other overrides."""
    parent, _, name = key.rpartition(".")
    beside = {".".join(k.split(".")[: key.count(".") + 1]) for k in flat(known) if k.startswith(f"{parent}.")}
    if value.partition(",")[0] in options(name):  # as data.scene=fern
        remedy = f"Did you mean +{name}={value}?"
    elif has_parameter(str(flat(known).get(f"{parent}.{TARGET}")), name):
        # of the user's own class, named by an override or a file
        remedy = f"Its class has it; a plus adds it: +{key}=…."
    elif not known and (CONF / key.partition(".")[0].replace("strategies", "strategy")).is_dir():
        # the options are in a folder that only Hydra's command line knows
        remedy = f"If its class has it, a plus adds it: +{key}=…."
    elif key.startswith("strategies.") and any(_SWEEPS.match(o) for o in overrides):
        remedy = (
            "Hydra composes a sweep first without what is swept, here the strategies. Sweep this setting, too "
            f"({key}=a,b), or name the strategies that remain (+strategy=[gco,svs])."
        )
    elif absent := [
        o for o in options("strategy") if key.startswith(f"strategies.{o}.") and o not in known["strategies"]
    ]:
        remedy = f"Its strategy is not in this run: +strategy={absent[0]}."
    elif name == TARGET:  # of a strategy or a decorator that is new
        remedy = f"A plus adds it: +{key}=…."
    elif f"~{key}" in overrides and beside:
        remedy = f"There are {', '.join(sorted(beside))}."
    elif near := _similar(key, [known_key for known_key in flat(known) if not known_key.endswith(TARGET)]):
        remedy = f"Did you mean {' or '.join(near)}?"
    elif known and config == "conductor":
        remedy = f"A conductor has settings of {', '.join(known)}."
    else:
        remedy = "clear-strategies --cfg job prints all of them."
    return remedy


def _similar(key: str, known: Sequence[str]) -> list[str]:
    """The keys that begin so; if there are none, the one that is spelled most alike, or those that end in the same name, as
    fit.viewer for viewer.
    """
    begin_so = [other for other in known if other.startswith(key) and "." not in other[len(key) :]]
    name = key.rpartition(".")[2]
    spelled_so = [  # strategies.mine.hr is like strategies.mine.weight only by what both begin with
        other
        for other in difflib.get_close_matches(key, known, 1, 0.8)
        if difflib.SequenceMatcher(None, other.rpartition(".")[2], name).ratio() >= 0.5
    ]
    return begin_so or spelled_so or [other for other in known if other.rpartition(".")[2] == name]
