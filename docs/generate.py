"""Writes the pages of docs/reference that are made from the code; a test compares them with it: `python docs/generate.py`.

`configuration.md` is made from conf/ and the classes that its `_target_`s name. A field's type and default come from the
signature of the class, its description from the `Args:` of the docstring, or from the comment beside it in the YAML file where
the docstring says nothing. On the other pages, what stands between `<!-- api NAME -->` and `<!-- end -->` is made from the
signatures and docstrings of a module, class or function; `<!-- api NAME alone -->` leaves out the members, `<!-- api NAME with
ONE OTHER -->` all but these. Parameters that are fields of the configuration are described there alone.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import itertools
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import signatures  # beside this file
from omegaconf import DictConfig, OmegaConf

ROOT: Final = Path(__file__).resolve().parents[1]
CONF: Final = ROOT / "conf"
REFERENCE: Final = ROOT / "docs" / "reference"
API: Final = re.compile(r"(<!-- api (\S+)(?: (alone|with [\w ]+))? -->\n).*?(<!-- end -->)", re.DOTALL)
OURS: Final = ("clear_strategies", "rasterizers", "integration")


@dataclass(frozen=True)
class Setting:
    """One field of the configuration."""

    name: str
    type: str
    default: str
    description: str


@dataclass(frozen=True)
class Section:
    """A node of the configuration: what builds it, and its fields."""

    choice: str
    key: str
    target: str | None
    summary: str
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class Group:
    """A folder of conf/: the choices that it holds, and the nodes that these set."""

    name: str
    options: Mapping[str, str]
    sections: tuple[Section, ...]


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """MkDocs calls this. Links to files outside docs/ work in a checkout; the site has no such files and shows the text alone."""
    here = Path(page.file.abs_src_path or ROOT).parent

    def text_alone(link: re.Match[str]) -> str:
        target = (here / link[2]).resolve()
        return link[0] if target.is_relative_to(ROOT / "docs") else link[1]

    return re.sub(r"\[([^\]]+)\]\((\.\.[^)#]*)(?:#[^)]*)?\)", text_alone, markdown)


def pages() -> dict[Path, str]:
    """What each page that is made from the code holds now, by its path."""
    listed = groups()
    api = Api(listed)
    made = {REFERENCE / "configuration.md": configuration(listed)}
    for path in sorted(REFERENCE.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        if path not in made and API.search(text):
            made[path] = _formatted(API.sub(lambda p: f"{p[1]}\n{api(p[2], p[3])}\n{p[4]}", text))
    return made


def _formatted(text: str) -> str:
    """Markdown whose Python is as `ruff format` leaves it."""
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", "page.md", "-"]
    return subprocess.run(command, input=text, capture_output=True, encoding="utf-8", check=True).stdout  # noqa: S603


class Api:
    """Markdown of the signatures and docstrings of this package, by griffe2md."""

    def __init__(self, listed: list[Group]) -> None:
        import griffe
        from griffe2md import prepare_env

        self._templates = prepare_env()  # of all items: to compile them takes most of the time
        loader = griffe.GriffeLoader(
            search_paths=[ROOT],
            docstring_parser=griffe.Parser.google,
            docstring_options={"warnings": False, "returns_multiple_items": False},
        )
        for package in OURS:
            loader.load(package)
        loader.resolve_aliases(implicit=False, external=False)
        self._found = loader.modules_collection
        sections = [section for group in reversed(listed) for section in reversed(group.sections) if section.target]
        self._configured = {
            self._item(str(section.target)).path: section for section in sections
        }  # the first of a class

    def __call__(self, name: str, members: str | None) -> str:
        """Without members (`alone`), with some of them (`with ONE OTHER`), or with all (None)."""
        from griffe2md import ConfigDict, prepare_context

        item = self._item(name)
        self._shorten(item)
        options = ConfigDict(
            heading_level=3, show_root_heading=not item.is_module, show_root_full_path=False, members_order="source",
            show_root_members_full_path=False, show_object_full_path=False, show_signature_annotations=True, line_length=100,
            show_if_no_docstring=False, show_bases=False, inherited_members=False, summary=False,
            members=None if members is None else members.split()[1:],
        )  # fmt: skip
        template = self._templates.get_template(f"{item.kind.value}.md.jinja")
        text = template.render(**prepare_context(item, options))
        # Its links lead to places of a site that has every object.
        return re.sub(r"<code>(.*?)</code>", r"`\1`", re.sub(r"\[([^\[\]]*)\]\(#[^)]*\)", r"\1", text)).strip() + "\n"

    def _item(self, name: str) -> Any:
        item = self._found[name]
        return item.final_target if item.is_alias else item

    def _shorten(self, item: Any) -> None:
        """Leave out of the docstrings what the signature or the configuration page says: types, and fields."""
        import griffe

        section = self._configured.get(item.path)
        fields = {setting.name for setting in section.settings} if section else set()
        parts = item.docstring.parsed if item.docstring else []
        for i, part in enumerate(list(parts)):
            if part.kind is griffe.DocstringSectionKind.returns:
                parts[i] = griffe.DocstringSectionText(f"**Returns:** {part.value[0].description}")
            if part.kind is not griffe.DocstringSectionKind.parameters:
                continue
            entries = [one for entry in part.value for one in self._split(entry, item)]
            part.value = kept = [one for one in entries if not fields.issuperset(one.name.split(", "))]
            if section and len(kept) < len(entries):
                text = f"Parameters: see {_link(section)}{' and below' if kept else ''}."
                parts[i : i + 1] = [griffe.DocstringSectionText(text), *([part] if kept else [])]
        for member in item.members.values():
            if not member.is_alias:
                self._shorten(member)

    def _split(self, entry: Any, item: Any) -> Iterator[Any]:
        """One entry for each parameter: "a: …. b: …" describes two. The signature has their types."""
        import griffe

        others = "|".join(parameter.name for parameter in item.parameters)
        for text in re.split(rf"(?<=[.;])\s+(?=(?:{others}): )", f"{entry.name}: {entry.description}"):
            name, _, description = text.partition(": ")
            yield griffe.DocstringParameter(name, description=description)


def groups() -> list[Group]:
    """Everything in conf/, the base configuration first. Each field is listed once, each class once per node."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    folders = sorted({path.parent for path in CONF.rglob("*.yaml") if path.parent != CONF}, key=str)
    # conf/conductor.yaml is left out: the fields of a conductor are among those of a run.
    return [_group(CONF, [CONF / "config.yaml"]), *(_group(folder, folder.glob("*.yaml")) for folder in folders)]


def _group(folder: Path, files: Iterable[Path]) -> Group:
    paths = sorted(files, key=lambda p: (not p.stem.startswith("_"), p.stem != "auto", p.stem))
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    sections = [section for path in paths for section in _sections(path, texts[path])]
    known = {f"{s.key}.{setting.name}" for s in sections if s.target for setting in s.settings}
    listed: list[Section] = []
    classes: set[tuple[str, str]] = set()
    sets: defaultdict[str, list[str]] = defaultdict(list)  # the fields that a choice sets and that are listed elsewhere
    for section in sections:
        if section.target:
            if (section.key, section.target) not in classes:
                classes.add((section.key, section.target))
                listed.append(section)
            continue
        own = tuple(s for s in section.settings if f"{section.key}.{s.name}" not in known)
        sets[section.choice] += [f"`{section.key}.{s.name}={s.default}`" for s in section.settings if s not in own]
        known |= {f"{section.key}.{s.name}" for s in own}
        if own:
            listed.append(dataclasses.replace(section, settings=own))
    options = {}
    for path in paths:
        if path.stem.startswith("_"):
            continue
        summaries = [s.summary for s in sections if s.choice == path.stem and s.summary]
        options[path.stem] = _heading(texts[path]) or next(iter(summaries), "")
        if sets[path.stem]:
            options[path.stem] += f" Sets {', '.join(sets[path.stem])}."
    return Group(folder.relative_to(CONF).as_posix(), options, tuple(listed))


def undescribed(listed: list[Group]) -> list[str]:
    """The fields that neither a docstring nor a comment describes."""
    sections = [section for group in listed for section in group.sections]
    return sorted({f"{s.key}.{setting.name}" for s in sections for setting in s.settings if not setting.description})


def configuration(listed: list[Group]) -> str:
    """The Markdown of the reference of the configuration."""
    lines = [
        "# Configuration",
        "",
        "This page is generated from `conf/` and from the classes that it builds. `--cfg job` prints the composed",
        "configuration of a run. A field is set on the command line by its full name: `strategies.gco.tolerance=0.1`.",
        "",
        "A *milestone* is an iteration number that is written for a run of 10,000 iterations. It is stretched to",
        "`fit.iterations`.",
        "",
    ]
    earlier: list[Section] = []
    for group in listed:
        lines += [f"## {'The base configuration' if group.name == '.' else f'`{group.name}=`'}", ""]
        if group.name != ".":
            lines += ["| choice | what it is |", "|---|---|"]
            lines += [f"| `{name}` | {_cell(text)} |" for name, text in group.options.items()]
            lines.append("")
        for section in group.sections:
            lines += [f"### {_title(section)}", ""]
            if section.target:
                lines += [f"`{section.target}`", ""]
            if section.summary:
                lines += [section.summary, ""]
            same = next((s for s in earlier if len(s.settings) > 1 and set(s.settings) <= set(section.settings)), None)
            if same:
                lines += [
                    f"The fields of {_link(same, '')}{', and:' if same.settings != section.settings else '.'}",
                    "",
                ]
            rows = [s for s in section.settings if not same or s not in same.settings]
            if rows:
                lines += ["| field | type | default | description |", "|---|---|---|---|", *_rows(rows), ""]
            earlier.append(section)
    return "\n".join(lines)


def _title(section: Section) -> str:
    if not section.key:
        return "Top level"
    return f"`{section.key}`" + (
        f" ({section.choice})" if section.choice[:1] != "_" and section.choice != "config" else ""
    )


def _link(section: Section, page: str = "configuration.md") -> str:
    anchor = re.sub(r"[^\w\- ]", "", _title(section).lower()).replace(" ", "-")
    return f"[`{section.key or 'the base configuration'}`]({page}#{anchor})"


def _rows(settings: Iterable[Setting]) -> Iterator[str]:
    """A row for each field, or for neighbours that share type and description."""
    for (kind, text), alike in itertools.groupby(settings, lambda s: (s.type, s.description)):
        for fields in [list(alike)] if text else [[s] for s in alike]:
            names, defaults = ([_code(getattr(s, part)) for s in fields] for part in ("name", "default"))
            shown = defaults[:1] if len(set(defaults)) == 1 else defaults
            yield f"| {', '.join(names)} | {_code(kind)} | {', '.join(shown)} | {_cell(text)} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def _code(text: str) -> str:
    return f"`{text}`" if text else ""  # a pipe inside backticks ends no cell


def _heading(text: str) -> str:
    """The comment at the top of a YAML file, up to its first sentence."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if "@package" not in line:
            lines.append(line.lstrip("# "))
    whole = " ".join(lines)
    return re.split(r"(?<=[.?])\s(?=[A-Z`]|python|experiment=)|: +(?=python)", whole, maxsplit=1)[0].rstrip(":")


def _sections(path: Path, text: str) -> Iterator[Section]:
    """The nodes of one file that are built from a class; in the base configuration and in a group of plain values, all."""
    package = re.search(r"^# @package (\S+)", text, re.MULTILINE)
    group = path.parent.relative_to(CONF).as_posix()
    here = package[1] if package else ("" if group == "." else group.replace("/", "."))
    config = OmegaConf.create(OmegaConf.load(path))
    if not isinstance(config, DictConfig):
        return
    skipped = {"defaults", "hydra"} if here in ("", "_global_") else {"defaults"}
    values = {str(k): v for k, v in config.items_ex(resolve=False) if k not in skipped}
    prefix = "" if here == "_global_" else here
    comments = _comments(text)
    plain = group == "." or (package is None and bool(values))
    for section in _walk(prefix, values, "", comments, plain=plain):
        yield dataclasses.replace(section, choice=path.stem)


def _walk(
    key: str, values: Mapping[str, Any], path: str, comments: Mapping[str, str], *, plain: bool
) -> Iterator[Section]:
    nodes = {k: v for k, v in values.items() if isinstance(v, DictConfig)}
    target = values.get("_target_")
    dotted = {name: f"{path}.{name}" if path else name for name in values}
    leaves = {name: signatures.shown(v) for name, v in values.items() if name not in nodes and not name.startswith("_")}
    notes = {name: comments.get(dotted[name], "") for name in values}
    inner: dict[str, Any] = {}
    if target:
        section, inner = _built(key, str(target), leaves, notes)
        yield section
    elif plain and leaves:
        yield Section(
            "", key, None, "", tuple(Setting(n, "", v, signatures.described(v, notes[n])) for n, v in leaves.items())
        )
    for name in dict.fromkeys([*inner, *nodes]):
        under = {str(k): v for k, v in nodes[name].items_ex(resolve=False)} if name in nodes else {}
        if name in inner and "_target_" not in under:
            kind = type(inner[name])
            own = {k: v for k, v in _values(inner[name]).items() if k not in under}
            under = {"_target_": f"{kind.__module__}.{kind.__qualname__}", **own, **under}
        yield from _walk(
            f"{key}.{name}" if key else name, under, dotted.get(name, f"{path}.{name}"), comments, plain=plain
        )


def _is_ours(built: Any) -> bool:
    return built.__module__.split(".")[0] in OURS


def _declaring(built: Any, field: str) -> Any:
    """The class that declares the field: a base may be another library's, whose own pages describe its fields."""
    if not inspect.isclass(built):
        return built
    return next((base for base in built.__mro__ if field in inspect.get_annotations(base)), built)


def _built(
    key: str, target: str, leaves: Mapping[str, str], notes: Mapping[str, str]
) -> tuple[Section, dict[str, Any]]:
    """The fields of the class or function that a node is built from; and the defaults that are dataclasses themselves."""
    leaves = {name: value for name, value in leaves.items() if value != "${reading:}"}  # the class's, by default
    module, _, name = target.rpartition(".")
    built = getattr(importlib.import_module(module), name)
    summary, described = (
        signatures.docstring(built) if _is_ours(built) else (f"A class of {built.__module__.split('.')[0]}.", {})
    )
    hints = signatures.hints(built)
    metadata = {f.name: f.metadata for f in dataclasses.fields(built)} if dataclasses.is_dataclass(built) else {}
    settings: dict[str, Setting] = {}
    inner: dict[str, Any] = {}
    for parameter in signatures.parameters(built):
        default = parameter.default
        if dataclasses.is_dataclass(default) and not isinstance(default, type):
            inner[parameter.name] = default
            continue
        if not _is_ours(_declaring(built, parameter.name)) and parameter.name not in leaves:
            continue
        if default is inspect.Parameter.empty and parameter.name not in leaves and (CONF / parameter.name).is_dir():
            continue  # a group of its own
        kind = hints.get(parameter.name, "")
        if "milestone" in metadata.get(parameter.name, {}):
            kind = f"{kind}, milestone"
        own = "???" if default is inspect.Parameter.empty else signatures.shown(default)
        value = leaves.get(parameter.name, own)
        text = described.get(parameter.name) or notes.get(parameter.name, "")
        settings[parameter.name] = Setting(parameter.name, kind, value, signatures.described(value, text))
    for name, value in leaves.items():
        if name not in settings and name not in inner:
            settings[name] = Setting(name, "", value, signatures.described(value, notes.get(name, "")))
    return Section("", key, target, summary, tuple(settings.values())), inner


def _values(instance: Any) -> dict[str, str]:
    """The fields of a dataclass as they are shown; without those that are dataclasses themselves."""
    values = {f.name: getattr(instance, f.name) for f in dataclasses.fields(instance) if f.init}
    return {name: signatures.shown(v) for name, v in values.items() if not dataclasses.is_dataclass(v)}


def _comments(text: str) -> dict[str, str]:
    """The comment behind each key of a YAML text, by the key's dotted path."""
    comments: dict[str, str] = {}
    stack: list[tuple[int, str]] = []
    current: str | None = None
    column = 0
    for line in text.splitlines():
        key = re.match(r"^(\s*)([\w+]+):(?:\s|$)", line)
        note = re.search(r"(?:^|\s)#\s?(.*)$", line)
        if key:
            stack = [(i, name) for i, name in stack if i < len(key[1])]
            stack.append((len(key[1]), key[2]))
            current = ".".join(name for _, name in stack)
            if note:
                comments[current], column = note[1].strip(), note.start()
            else:
                column = -1
        elif note and current in comments and column > 0 and abs(note.start() - column) <= 1:
            comments[current] += " " + note[1].strip()
    return comments


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
