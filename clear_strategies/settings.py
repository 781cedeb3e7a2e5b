"""From settings as plain values, given by a configuration file or a command line, to checked objects.

A node is a dict of plain values. With the key `_target_`, the dotted name of a class or function, it describes one call:
`defaults` fills in every argument that the node leaves out, from the signature itself, and `build` checks the node and
makes the call. So each default is set in one place, the class, and no object is built from an unchecked setting.
A `_target_` may name any class or function: a configuration is trusted as Hydra's is.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import math
import re
import traceback
import types
import typing
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, MutableSequence, MutableSet, Sequence, Set
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final, Literal, Union, get_args, get_origin

from beartype import BeartypeConf
from beartype.door import is_bearable
from beartype.roar import BeartypeDecorHintPep585DeprecationWarning, BeartypeException

from clear_strategies.errors import DataError, SettingError, one_line
from clear_strategies.signatures import signature_of
from rasterizers.interface import BackendUnavailable

TARGET: Final = "_target_"
_PARTIAL: Final = "_partial_"  # true: `build` returns a functools.partial, which waits for further arguments
_KEYWORDS: Final = (TARGET, _PARTIAL)
LISTED: Final = "listed"
"""False in the metadata of a dataclass field: its default is not written into the node."""
_MISSING: Final = "???"
CHANGES_NO_RESULT: Final = frozenset(
    f"fit.{name}"
    for name in (
        "checkpoint_every", "keep", "map_views", "memory", "overwrite", "probe_every", "probe_views", "resume",
        "threads", "verbose", "video", "viewer",
    )
) | {"rasterizer.memory"}  # fmt: skip
"""Settings that do not change a bit of the trained field: what is kept, shown and written beside it, and how fast. Resuming
does not compare them, a sweep's folders are not named by them, and a report does not distinguish runs by them.
"""
_NUMBERS: Final = BeartypeConf(is_pep484_tower=True)  # an int is accepted where a float is asked for
# What a list becomes, by the annotation.
_KINDS: Final[Mapping[Any, Callable[[list[Any]], Any]]] = {
    **dict.fromkeys((list, Sequence, MutableSequence, Collection, Iterable), list),
    **dict.fromkeys((set, Set, MutableSet), set), frozenset: frozenset, tuple: tuple,
}  # fmt: skip
_EMPTY: Final = inspect.Parameter.empty
_VARIADIC: Final = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_ABSENT: Final = object()


def with_defaults(node: Any) -> Any:
    """The node with the defaults of every `_target_` in it, nested dataclasses included; values of the node win.

    A target that cannot be imported is left as it is; `build` refuses it, if the node is used at all.
    """
    if isinstance(node, list):
        return [with_defaults(value) for value in node]
    if not isinstance(node, Mapping):
        return node
    node = {key: with_defaults(value) for key, value in node.items()}
    try:
        if node.get(TARGET) is None:
            return node
        return _merged(_defaults(_located(node[TARGET])), node)
    except (ImportError, AttributeError):
        return node


def defaults_of(target: str, *field: str) -> Any:
    """The default that the class or function of a dotted name has for a field, or for an entry of it."""
    return functools.reduce(lambda node, name: node[name], field, _defaults(_located(target)))


def flat(node: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """The leaves of a tree by their dotted keys. The entries of a list that holds tables or lists have their number as key."""
    leaves: dict[str, Any] = {}
    for name, value in node.items():
        nested = isinstance(value, list) and any(isinstance(entry, dict | list) for entry in value)
        below = dict(enumerate(value)) if nested else value
        leaves |= flat(below, f"{prefix}{name}.") if isinstance(below, dict) else {f"{prefix}{name}": value}
    return leaves


def key_of(override: str) -> str:
    """The dotted key or the group of an override as it is written."""
    return override.lstrip("+~").partition("=")[0]


def build(node: Any, key: str = "") -> Any:
    """Build the object that a node describes, by calling its `_target_` after building the nodes inside it.

    Args:
        key: of the node in the configuration, for messages.

    Raises:
        SettingError: an unknown or missing key, a value of another type, a number that is not finite, or a value that
            the class itself refuses. The message begins with the key.
    """
    if isinstance(node, Mapping):
        if node.get(TARGET) is not None:
            return _called(node, key)
        return {name: build(value, _joined(key, name)) for name, value in node.items()}
    if isinstance(node, list):
        return [build(value, f"{key}[{i}]") for i, value in enumerate(node)]
    if isinstance(node, float) and not math.isfinite(node):
        raise SettingError(f"{key}: must be a finite number, got {node}.")
    return node


def absent(tree: Mapping[str, Any]) -> str | None:
    """The key of the first required value that is not given; None if all are."""
    return next((key for key, value in flat(tree).items() if value == _MISSING), None)


def missing(key: str, *, known: bool = True) -> SettingError:
    """The error for a setting that has no default.

    Args:
        known: the configuration has the key; else Hydra adds it by a plus.
    """
    return SettingError(f"{key}: is needed and missing. Add {'' if known else '+'}{key}=….")


def _called(node: Mapping[str, Any], key: str) -> Any:
    target = node[TARGET]
    function = located(target, key)
    parameters, hints = _parameters(function), _hints(function)
    given = {name: value for name, value in node.items() if name not in _KEYWORDS}
    _refuse_unknown(given, parameters, key, str(target))
    arguments, own = {}, _own_defaults(function)
    defaults = _defaults(function, own)
    for name, value in given.items():
        if name in defaults and repr(value) == repr(defaults[name]):  # not ==: to Python true is 1
            arguments[name] = own[name]  # a text may stand for what no text becomes again, by its annotation
            continue
        inner = _joined(key, name)
        built = build(_as_node(value, defaults.get(name), hints.get(name)), inner)
        arguments[name] = _of_type(built, hints[name], inner) if name in hints else built
    partial = functools.partial(function, **arguments)
    if node.get(_PARTIAL):
        return partial
    needed = {name for name, p in parameters.items() if p.default is _EMPTY and p.kind not in _VARIADIC}
    if absent := sorted(needed - set(arguments)):
        raise missing(_joined(key, absent[0]), known=False)
    try:
        return partial()
    except DataError:
        raise
    except (ValueError, BackendUnavailable) as error:
        raise SettingError(_with_key(one_line(error), key, parameters)) from error


def located(target: Any, key: str) -> Callable[..., Any]:
    """The class or function of a dotted name; a SettingError, which begins with the key, where it cannot be imported."""
    try:
        return _located(target)
    except Exception as error:  # whatever a module does when it is imported
        if place := _place_in_module(error):
            cause = f"{place}: {type(error).__name__}: {one_line(error)}"
            raise SettingError(f"{key}: {target} cannot be imported: {cause}. Correct that file.") from error
        if not isinstance(error, ImportError | AttributeError):
            raise
        of_this_package = str(target).startswith(("clear_strategies.", "rasterizers."))
        remedy = "pip install 'clear-strategies[train]'" if of_this_package else "Correct its name, or PYTHONPATH"
        raise SettingError(f"{key}: {target} cannot be imported ({one_line(error)}). {remedy}.") from error


def _place_in_module(error: Exception) -> str:
    """File and line of the module that raises while it is imported; empty where the module is not there."""
    # What the decorator of a dataclass refuses is written below it.
    passed_on = re.compile(r"importlib|[/\\]dataclasses\.py$")
    last = [frame for frame in traceback.extract_tb(error.__traceback__) if not passed_on.search(frame.filename)][-1]
    return "" if last.filename == __file__ else f"{last.filename}:{last.lineno}"


def _with_key(message: str, key: str, parameters: Mapping[str, Any]) -> str:
    """The message with the key of the configuration in front, which is that of the field that the message begins with, and
    with the whole key of the field in its remedy.
    """
    if not key or message.startswith((f"{key}.", f"{key}:")):
        return message
    if (name := message.partition(" ")[0].rstrip(":")) not in parameters:
        return f"{key}: {message}"
    with_keys = re.sub(rf"(?<![\w.]){name}=", f"{key}.{name}=", message)
    return f"{key}.{with_keys}"


def _located(target: Any) -> Callable[..., Any]:
    """The class or function of a dotted name; an ImportError or AttributeError where it is not there."""
    module, _, name = str(target).rpartition(".")
    if not module or module.startswith("."):
        raise ImportError("it is no dotted name")
    function = getattr(importlib.import_module(module), name)
    try:
        signature_of(function)
    except (ValueError, TypeError) as error:  # no function, or one that is built in
        raise ImportError(f"it is no class or function whose parameters are known: {one_line(error)}") from error
    return typing.cast("Callable[..., Any]", function)


def has_parameter(target: str, name: str) -> bool:
    """Return True if the class or function of a dotted name can be imported and takes this."""
    try:
        return name in _parameters(_located(target))
    except Exception:  # whatever a module does when it is imported: `build` tells
        return False


def _parameters(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    return {name: p for name, p in signature_of(function).parameters.items() if not name.startswith("_")}


def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Type annotations by parameter; none where they name something that cannot be looked up."""
    annotated = function.__init__ if isinstance(function, type) and not is_dataclass(function) else function  # type: ignore[misc]
    try:
        return typing.get_type_hints(annotated)
    except (NameError, TypeError, AttributeError):
        return {}


def _own_defaults(function: Callable[..., Any]) -> dict[str, Any]:
    """The defaults of its signature, a new one where a dataclass has a factory."""
    defaults = {name: p.default for name, p in _parameters(function).items() if p.default is not _EMPTY}
    made = fields(function) if is_dataclass(function) else ()
    return defaults | {
        f.name: f.default_factory() for f in made if f.name in defaults and f.default_factory is not MISSING
    }


def _defaults(function: Callable[..., Any], own: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The node that calls the function with all of its defaults, which `_own_defaults` may have made already."""
    declared = fields(function) if is_dataclass(function) else ()
    unlisted = {f.name for f in declared if not f.metadata.get(LISTED, True)}
    own = _own_defaults(function) if own is None else own
    plain = {name: _plain(default) for name, default in own.items() if name not in unlisted}
    return {TARGET: None, **{name: value for name, value in plain.items() if value is not _ABSENT}}


def _plain(value: Any) -> Any:
    """A default as a configuration holds it; `_ABSENT` for what no configuration can hold."""
    if isinstance(value, Enum):
        return value.name if value.name in type(value).__members__ else _ABSENT  # several flags have no name
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Set):
        value = sorted(value, key=str)  # the same order in each process
    if isinstance(value, tuple | list):
        items = [_plain(item) for item in value]
        return _ABSENT if _ABSENT in items else items
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value)
        inner = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
        value = {TARGET: f"{kind.__module__}.{kind.__qualname__}", **inner}
    if isinstance(value, Mapping):
        entries = {key.name if isinstance(key, Enum) else str(key): _plain(item) for key, item in value.items()}
        return _ABSENT if _ABSENT in entries.values() else entries
    return _ABSENT


def _merged(defaults: Mapping[str, Any], node: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults, replaced by the values of the node; a nested node of another `_target_` replaces the default as a whole."""
    merged = {**defaults}
    for key, value in node.items():
        default = merged.get(key)
        if isinstance(default, Mapping) and isinstance(value, Mapping):
            same = value.get(TARGET, default.get(TARGET)) == default.get(TARGET)
            merged[key] = _merged(default, value) if same else value
        else:
            merged[key] = value
    return merged


def _as_node(value: Any, default: Any, hint: Any) -> Any:
    """The node of a nested dataclass, of which a setting names fields alone; another value as it is."""
    if not isinstance(value, Mapping) or TARGET in value:
        return value
    if isinstance(default, Mapping) and TARGET in default:
        return _merged(default, value)
    kind: Any = next((part for part in _parts(hint) if is_dataclass(part)), None)
    return value if kind is None else {TARGET: f"{kind.__module__}.{kind.__qualname__}", **value}


def _refuse_unknown(
    given: Mapping[str, Any], parameters: Mapping[str, inspect.Parameter], key: str, target: str
) -> None:
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return
    known = [name for name, p in parameters.items() if p.kind not in _VARIADIC]
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            remedy = f"Did you mean {_joined(key, near[0])}?" if near else f"There is {', '.join(known) or 'none'}."
            raise SettingError(f"{_joined(key, name)}: {target} has no such setting. {remedy}")


def _of_type(value: Any, hint: Any, key: str) -> Any:
    """The value as the annotated type, see `_fitted`."""
    if (fitted := _fitted(value, hint)) is not _ABSENT:
        return fitted
    for part in _parts(hint):
        if isinstance(value, dict) and _is_table(part):
            for name, entry in value.items():
                _of_type(entry, get_args(part)[1], _joined(key, name))  # the wrong entry is named
    shown = repr(value) if isinstance(value, str | int | float | list | Mapping | None) else f"a {type(value).__name__}"
    remedy = ""
    if is_dataclass(hint):
        names = ", ".join(_joined(key, f.name) for f in fields(hint) if f.init)
        remedy = f" Set {names}." if names else f" ~{key} leaves it out."
    elif isinstance(value, int | float) and _fitted(str(value), hint) is not _ABSENT:
        remedy = f" As text it is written '{key}=\"{value}\"'."
    raise SettingError(f"{key}: must be {_in_words(hint)}, got {shown}.{remedy}")


def _parts(hint: Any) -> Sequence[Any]:
    """The alternatives of an annotation."""
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _is_table(hint: Any) -> bool:
    origin = get_origin(hint)
    return isinstance(origin, type) and issubclass(origin, Mapping) and len(get_args(hint)) == 2


def _members(hint: Any) -> Mapping[str, Enum]:
    """The members of an Enum, or those that a Literal names."""
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint.__members__
    return {part.name: part for part in get_args(hint) if isinstance(part, Enum)} if get_origin(hint) is Literal else {}


def _member(value: Any, hint: Any) -> Any:
    """The member of `_members` by its name, or by its value; else `_ABSENT`."""
    members = _members(hint)
    by_value = (
        m for m in members.values() if value == m.value and isinstance(value, bool) == isinstance(m.value, bool)
    )
    return members[value] if isinstance(value, str) and value in members else next(by_value, _ABSENT)


def _fitted(value: Any, hint: Any) -> Any:
    """The value if it is of the annotated type; a list as the tuple or set that is asked for, a text as the path or the member
    of an Enum; else `_ABSENT`.
    """
    if len(alternatives := _parts(hint)) > 1:
        fits = [fit for part in alternatives if (fit := _fitted(value, part)) is not _ABSENT]
        return next((fit for fit in fits if fit is value), fits[0] if fits else _ABSENT)
    origin, parts = get_origin(hint) or hint, get_args(hint)
    if _is_table(hint) if isinstance(value, dict) else isinstance(value, list | str) and origin in _KINDS:
        return _with_entries_fitted(value, origin, parts)
    if (member := _member(value, hint)) is not _ABSENT:
        return member
    if isinstance(value, bool) and (hint in (int, float) or (origin is Literal and not any(value is x for x in parts))):
        return _ABSENT  # to Python true is 1, to a user it is not
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", BeartypeDecorHintPep585DeprecationWarning)
            forms = (value, Path(value)) if isinstance(value, str) else (value,)
            return next((form for form in forms if is_bearable(form, hint, conf=_NUMBERS)), _ABSENT)
    except BeartypeException:  # a hint that beartype does not support
        return value


def _with_entries_fitted(value: list[Any] | str | dict[Any, Any], origin: Any, parts: tuple[Any, ...]) -> Any:
    """`_fitted` of a list or table. Every entry is looked at: beartype looks at one of a sequence, which it draws by `random`, so
    a wrong one may pass, and the program's own random numbers change.
    """
    if isinstance(value, dict):
        items = [(_fitted(name, parts[0]), _fitted(entry, parts[1])) for name, entry in value.items()]
        return _ABSENT if any(fit is _ABSENT for item in items for fit in item) else dict(items)
    of_each = parts if origin is tuple and parts and parts[1:] != (...,) else (parts[:1] or (Any,)) * len(value)
    if isinstance(value, str) or len(value) != len(of_each):
        return _ABSENT
    fits = [*map(_fitted, value, of_each)]
    return _ABSENT if any(fit is _ABSENT for fit in fits) else _KINDS[origin](fits)


_WORDS: Final[Mapping[Any, str]] = {
    int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "null", Path: "a path",
}  # fmt: skip


def _in_words(hint: Any) -> str:
    """An annotation in words, for users of YAML."""
    origin, inner = get_origin(hint) or hint, get_args(hint)
    words = f"a {origin.__name__}" if isinstance(origin, type) else str(hint)
    if hint in _WORDS:
        words = _WORDS[hint]
    elif len(alternatives := _parts(hint)) > 1:
        words = " or ".join(dict.fromkeys(map(_in_words, alternatives)))
    elif origin is Literal or _members(hint):
        words = " or ".join(x.name if isinstance(x, Enum) else str(x) for x in inner or _members(hint))
    elif origin is tuple and inner and inner[1:] != (...,):
        each = "numbers" if {*inner} <= {int, float} else f"entries ({', '.join(map(_in_words, inner))})"
        words = f"a list of {len(inner)} {each}"
    elif origin in _KINDS:
        words = "a list" + (f", each entry {_in_words(inner[0])}" if inner else "")
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        words = "a table of names"
    return words


def _joined(key: str, name: Any) -> str:
    return f"{key}.{name}" if key else str(name)
