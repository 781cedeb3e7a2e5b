"""The arguments of a class or function: types and defaults from its signature, descriptions from its docstring."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import re
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf


def parameters(built: Any) -> Iterator[inspect.Parameter]:
    """The parameters; a dataclass's default factories are called, so that their result is shown."""
    factories = {}
    if dataclasses.is_dataclass(built):
        factories = {
            f.name: f.default_factory for f in dataclasses.fields(built) if f.default_factory is not dataclasses.MISSING
        }
    for parameter in inspect.signature(built).parameters.values():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        factory = factories.get(parameter.name)
        yield parameter.replace(default=factory()) if factory is not None else parameter


def hints(built: Any) -> dict[str, str]:
    function = built.__init__ if inspect.isclass(built) else built
    annotations: dict[str, Any] = dict(getattr(function, "__annotations__", {}))
    try:
        resolved: Mapping[str, Any] = typing.get_type_hints(function)
    except (NameError, TypeError):
        resolved = {}
    return {name: _type(resolved.get(name, annotation)) for name, annotation in annotations.items()}


def _type(annotation: Any) -> str:
    if typing.get_origin(annotation) is typing.Union:  # written alike by each version of Python
        return " | ".join("None" if part is type(None) else _type(part) for part in typing.get_args(annotation))
    if isinstance(annotation, type):
        return annotation.__name__
    text = annotation if isinstance(annotation, str) else repr(annotation)
    return re.sub(r"\b(?:[A-Za-z_]\w*\.)+(?=\w)", "", text)


def shown(value: Any) -> str:
    """A value as it is written in YAML."""
    if isinstance(value, ListConfig | DictConfig):
        value = OmegaConf.to_container(value, resolve=False)
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(shown(v) for v in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{k}: {shown(v)}' for k, v in value.items())}}}"
    return '""' if value == "" else str(value)


def docstring(built: Any) -> tuple[str, dict[str, str]]:
    """The first paragraph, and the description of each argument."""
    summary = " ".join((inspect.getdoc(built) or "").split("\n\n")[0].split())
    if summary.startswith(f"{built.__name__}("):  # a dataclass without a docstring
        summary = ""
    described: dict[str, str] = {}
    for owner in reversed(inspect.getmro(built)[:-1] if inspect.isclass(built) else (built,)):
        described |= _arguments(inspect.cleandoc(owner.__doc__ or ""))
    return summary, described


def _arguments(text: str) -> dict[str, str]:
    """The descriptions in the `Args:` of a docstring, by argument."""
    import griffe

    sections = griffe.Docstring(text).parse(griffe.Parser.google, warnings=False)
    listed = [section.value for section in sections if section.kind is griffe.DocstringSectionKind.parameters]
    described: dict[str, str] = {}
    for entry in itertools.chain.from_iterable(listed):
        # "a, b: …" describes both; "a: …. b: …" in one entry describes each.
        whole = f"{entry.name}: {' '.join(entry.description.split())}"
        for part in re.split(r"(?<=[.;])\s+(?=[a-z_]\w*: )", whole):
            names, _, description = part.partition(":")
            described |= {n.strip().lstrip("*"): description.strip() for n in names.split(",")}
    return described


def described(value: str, text: str) -> str:
    """The description; of a value that is required, or that follows another field, it says so."""
    if value == "???":
        text = f"Required. {_sentence(text)}".strip()
    elif not text and value.startswith("${"):
        text = "Follows the field that its default names."
    return _sentence(text)


def _sentence(text: str) -> str:
    text = " ".join(text.replace("(10k)", "").split())  # the type says that it is a milestone
    return text[:1].upper() + text[1:] if re.match(r"[a-z]+ [a-z(`]", text) else text
