"""What the documentation names exists: links, paths, symbols, settings, numbers of its tables."""

import ast
import csv
import inspect
import pkgutil
import re
import subprocess
from collections import Counter
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import clear_strategies
from clear_strategies import Strategy
from clear_strategies.compose import composed
from clear_strategies.options import CONF
from tests.helpers.pages import DOCS, GENERATE, OURS, PAGES, ROOT, loaded, name


def test_the_public_api_lists_what_the_package_exports_and_tests_that_the_paper_page_names_exist():
    """`test_what_a_page_names_exists` checks that what it lists exists."""
    listed = set(re.findall(r"`clear_strategies\.(\w+)`", (DOCS / "reference" / "public-api.md").read_text()))
    assert set(clear_strategies.__all__) - listed == {"ATTRIBUTES", "CONFLICT_GROUPS"}
    equations = (DOCS / "explanation" / "paper.md").read_text().split("## Readings")[0]
    named = set(re.findall(r"`(test_\w+)`", equations))
    source = "".join(p.read_text() for p in (ROOT / "tests").rglob("test_*.py"))
    assert named
    assert not {test for test in named if f"def {test}(" not in source}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_what_a_page_names_exists(page):
    """Links, paths, `file:symbol`, dotted names, and [`symbol`](file), perhaps behind its module; a table of files has its folder
    in the heading.
    """
    text = page.read_text()
    for target, _, anchor in (link.partition("#") for link in re.findall(r"\]\(((?!https?:)[^)\s]+)\)", text)):
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), target
        assert not anchor or anchor in anchors(path), f"{target}#{anchor}"
    paths = re.findall(r"`((?:clear_strategies|rasterizers|integration|conf|tests|docs)/[\w./-]*)`", text)
    for folder, rows in re.findall(r"^\| file of `([^`]+)` \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", text, re.MULTILINE):
        cells = [row.split("|")[1] for row in rows.splitlines()]
        paths += [f"{folder}/{file}" for cell in cells for file in re.findall(r"`([^`]+)`", cell)]
    assert not [path for path in paths if not (ROOT / path).exists()]
    stations = re.findall(r"`([\w./-]+\.(?:py|cpp|hpp|yaml|md)):([\w.]+)`", text)
    assert not [f"{file}:{symbol}" for file, symbol in stations if not holds(ROOT / file, symbol)]
    linked = re.findall(r"\[`(?:[a-z_]+\.)*([\w.]+)`\]\(([^)\s]+\.py)\)", text)
    assert not [f"{file}:{symbol}" for symbol, file in linked if not holds((page.parent / file).resolve(), symbol)]
    dotted = re.findall(rf"`((?:{'|'.join(OURS)})(?:\.\w+)+)", text)
    assert not [one for one in dict.fromkeys(dotted) if not exists(one)]


@cache
def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them; those of the site are tested by `mkdocs build --strict`."""
    prose = re.sub(r"^( *)```.*?^\1```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    found: Counter[str] = Counter()
    listed = set()
    for heading in re.findall(r"^#{1,6} +(.*)$", prose, re.MULTILINE):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        listed.add(f"{slug}-{found[slug]}" if found[slug] else slug)
        found[slug] += 1
    return listed


def holds(file: Path, symbol: str) -> bool:
    """Whether a file defines a symbol; one that is not Python, whether it has the word."""
    if file.suffix != ".py":
        return file.is_file() and re.search(rf"\b{symbol}\b", file.read_text()) is not None
    body = ast.parse(file.read_text()).body if file.is_file() else []
    for part in filter(None, symbol.split(".")):
        defined = next((node for node in body if part in names_of(node)), None)
        if defined is None:
            return False
        body = getattr(defined, "body", [])
    return True


def names_of(node: ast.stmt) -> set[str]:
    targets = [*getattr(node, "targets", []), getattr(node, "target", None)]
    return {getattr(node, "name", ""), *(target.id for target in targets if isinstance(target, ast.Name))}


def exists(dotted: str) -> bool:
    with suppress(AttributeError, ImportError):
        pkgutil.resolve_name(dotted)
        return True
    parts = dotted.split(".")  # perhaps of a module that imports a host which is not installed
    paths = {n: ROOT.joinpath(*parts[:n]) for n in range(1, len(parts) + 1)}
    sources = [(file, parts[n:]) for n, p in paths.items() for file in (p.with_suffix(".py"), p / "__init__.py")]
    return any(file.is_file() and holds(file, ".".join(rest)) for file, rest in sources)


def test_pages_that_the_code_names_exist():
    tracked = subprocess.run(["git", "ls-files"], capture_output=True, text=True, cwd=ROOT, check=False).stdout.split()
    if not tracked:
        pytest.skip("not a checkout")
    sources = [ROOT / path for path in tracked if path.endswith((".py", ".yaml", ".toml", ".hpp", ".cpp", ".md"))]
    named = {
        (path, source.relative_to(ROOT).as_posix())
        for source in sources
        if source.is_file()
        for path in re.findall(r"\bdocs/[\w/-]+\.md", source.read_text())
    }
    assert not sorted(where for where in named if not (ROOT / where[0]).exists())


CONFIG = composed(["+strategy=clear"], "config")


def test_config_fields_that_pages_name_exist():
    groups = "data|strategies|decorators|objective|density|optim|mip|rasterizer|fit|skips"
    for page in (page for page in PAGES if page.name != "CHANGELOG.md"):  # which names what is gone
        # "strategies.svs.anchor_strength=0" and "fit.resume=…" name a field, too
        for field in re.findall(rf"`((?:{groups})\.[\w.]+)(?:=[^`]*)?`", page.read_text()):
            key, _, last = field.rpartition(".")
            described = any(
                field == section.key or (key == section.key and last in {setting.name for setting in section.settings})
                for group in GROUPS
                for section in group.sections
            )
            select = OmegaConf.select(CONFIG, field, default="absent", throw_on_missing=False)
            assert described or select != "absent", f"{name(page)}: {field}"


GROUPS = GENERATE.groups()


def test_the_configuration_page_describes_every_choice_and_every_setting():
    assert GENERATE.undescribed(GROUPS) == []
    page = GENERATE.configuration(GROUPS)
    for path in CONF.rglob("*.yaml"):
        if not path.stem.startswith("_") and path.parent != CONF:
            assert f"| `{path.stem}` |" in page, path


def test_the_pages_that_are_made_from_the_code_are_committed_as_they_are_made():
    pytest.importorskip("griffe2md")
    changed = [name(path) for path, made in GENERATE.pages().items() if path.read_text() != made]
    assert not changed, "run python docs/generate.py"


def test_the_table_of_hooks_shows_the_hooks_of_a_strategy():
    page = (DOCS / "how-to" / "own-strategy.md").read_text()
    shown = dict(re.findall(r"^\| `(\w+)\(([^)]*)\)`", page, re.MULTILINE))
    assert shown
    for hook, arguments in shown.items():
        assert ", ".join([*inspect.signature(getattr(Strategy, hook)).parameters][1:]) == arguments, hook


def test_pictures_are_drawn_from_the_tables(tmp_path):
    figures = loaded(DOCS / "figures.py")
    figures.main(tmp_path)
    pages = "".join(path.read_text() for path in (DOCS / "explanation").glob("*.md"))
    named = set(re.findall(r"images/(evidence_\w+\.svg)", pages))
    assert named == {path.name for path in tmp_path.iterdir()}
    assert all((DOCS / "images" / picture).exists() for picture in named)


def test_numbers_of_a_summary_are_those_of_its_table():
    """Every row of a small table on the evidence pages stands in the CSV file that is linked below it."""
    page = "".join(path.read_text() for path in sorted((DOCS / "explanation").glob("evidence*.md")))
    checked = 0
    for section in page.split("\n## ")[1:]:
        tables = re.findall(r"^\|.*\n\|[-|]+\|\n((?:\|.*\n)+)", section, re.MULTILINE)
        linked = re.search(r"\]\(\.\./data/evidence/(\w+\.csv)\)", section)
        if linked is None:
            continue
        numbers = r"(?<![\w.])[+-]?\d[\d,]*\.?\d*(?![\w.]*[A-Za-z])"
        with (DOCS / "data" / "evidence" / linked[1]).open(newline="") as file:
            known = {number for row in csv.reader(file) for cell in row for number in re.findall(numbers, cell)}
        for row in "".join(tables).splitlines():
            cells = row.replace("*", "").split("|")[2:]
            assert not set(re.findall(numbers, " | ".join(cells))) - known, row
            checked += 1
    assert checked > 30
