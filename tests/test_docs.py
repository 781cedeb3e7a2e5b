"""What the documentation says runs, and what it points to exists."""

from __future__ import annotations

import argparse
import ast
import csv
import fnmatch
import importlib
import importlib.util
import inspect
import itertools
import json
import re
import runpy
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import create_config_search_path
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import setup_globals
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from PIL import Image

import clear_strategies
from clear_strategies import Conductor, Strategy
from clear_strategies.commands import train
from clear_strategies.compose import CONF, OPTIONS
from tests.helpers import command_line, documented

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    ROOT / "integration" / "README.md",
    *sorted(DOCS.rglob("*.md")),
]
OURS = ("clear_strategies", "rasterizers", "integration")


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def loaded(path: Path) -> ModuleType:
    """A Python file of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(f"docs_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


HOOKS = loaded(DOCS / "hooks.py")


def blocks(page: Path, *languages: str) -> list[str]:
    """The fenced blocks of these languages; those inside lists are dedented."""
    found = re.findall(rf"^( *)```(?:{'|'.join(languages)})\n(.*?)^ *```", page.read_text(), re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


def commands(block: str) -> Iterator[list[str]]:
    """The words of every simple command of a shell block, without variables set before it and redirections after it."""
    for line in block.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        words: list[str] = []
        for word in itertools.chain(lexer, [";"]):
            if set(word) <= set(";&|"):
                redirected = next((i for i, w in enumerate(words) if set(w) <= set("<>&")), len(words))
                words = words[:redirected]
                while words and (words[0] == "do" or re.fullmatch(r"\w+=.*", words[0])):
                    words = words[1:]
                if words:
                    yield words
                words = []
            else:
                words.append(word)


# Each command once, by the first page that has it.
COMMANDS = {
    " ".join(words): pytest.param(words, id=f"{name(page)}: {' '.join(words)[:60]}")
    for page in reversed(PAGES)
    for block in blocks(page, "sh", "bash")
    for words in commands(block)
}.values()
README_LOOP, *_ = blocks(ROOT / "README.md", "python")
PYTHON = [
    pytest.param(block, id=f"{name(page)}-{i}")
    for page in PAGES
    for i, block in enumerate(blocks(page, "python"))
    if block != README_LOOP  # has a test of its own
]
# Commands of other programs: nothing of them is checked, but that extras exist.
FOREIGN = r"(python3? -m (venv|pip|build)|cibuildwheel|\.|pip install|for|done|wait|ns-train|mkdocs|pre-commit|tensorboard|cd) ?"

READ_BY_ARGPARSE = ("render", "export", "view", "doctor")  # subcommands; the others read Hydra's words


class Parsed(Exception):
    """Raised once a command line was understood."""


@pytest.mark.parametrize("words", COMMANDS)
def test_commands_are_understood(words, monkeypatch, tmp_path):
    line = " ".join(words)
    if words[0] == "clear-strategies" and words[1] in READ_BY_ARGPARSE:
        require_parsable("clear_strategies.run", words[1:], monkeypatch)
    elif words[:2] == ["clear-strategies", "train"]:
        require_composable(train.overrides([str(tmp_path), *words[3:]]))
    elif words[:2] == ["clear-strategies", "settings"]:
        require_composable(words[2:])
    elif words[:3] == ["python", "-m", "clear_strategies.run"] or words[0] == "clear-strategies":
        require_composable(words[1:] if words[0] == "clear-strategies" else words[3:])
    elif words[:3] == ["python", "-m", "pytest"]:
        paths = [word for word in words[3:] if "/" in word]
        assert all((ROOT / path).exists() for path in paths), line
    elif words[:2] == ["python", "-m"] and words[2].startswith(OURS):
        require_parsable(words[2], words[3:], monkeypatch)
    else:
        assert re.match(FOREIGN, line), f"{line}: no test knows this command"
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        for named in re.findall(r"(?:^|\s|')(?:\.|clear-strategies)\[([\w,-]+)\]", line):
            assert set(named.split(",")) <= set(extras), line


def require_composable(arguments: list[str]) -> None:
    """The configuration of a run, or of every value of a sweep, composes and makes a conductor."""
    overrides = [word for word in arguments if "=" in word or word.startswith("~")]
    flags = [word for word in arguments if word not in overrides]
    assert set(flags) <= {"-m", "--cfg", "job"}, flags
    whole = loader().load_configuration("config", overrides, run_mode=RunMode.MULTIRUN, validate_sweep_overrides=False)
    if "-m" not in flags and whole.hydra.mode != RunMode.MULTIRUN:
        require_conductor(loader().load_configuration("config", overrides, run_mode=RunMode.RUN))
        return
    swept = [f"{key}={value}" for key, value in (whole.hydra.sweeper.params or {}).items()]
    parsed = OverridesParser.create(loader()).parse_overrides([*swept, *overrides])
    (jobs,) = BasicSweeper.split_arguments(parsed, None)
    chosen: set[str] = set()
    for job in jobs:
        files = {word for word in job if (CONF / word.lstrip("+").split("=")[0]).is_dir()}
        if not chosen or files - chosen:  # the first job, and each that takes a file that no job before it took
            chosen |= {*files, ""}
            require_conductor(loader().load_sweep_config(whole, list(job)))


@cache
def loader() -> ConfigLoaderImpl:
    setup_globals()
    Plugins.instance()
    return ConfigLoaderImpl(create_config_search_path(str(CONF)))


def require_conductor(config: DictConfig) -> None:
    targets = [str(node.get("_target_")) for node in config.strategies.values()]
    if all(target.startswith(OURS) for target in targets):
        objective, *strategies = (
            instantiate(node, _convert_="object") for node in (config.objective, *config.strategies.values())
        )
        Conductor(*strategies, objective=objective)


def require_parsable(module: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The module's own parser accepts the arguments; nothing is done with them."""
    parse = argparse.ArgumentParser.parse_args

    def parse_alone(self: argparse.ArgumentParser, *args: object) -> None:
        parse(self, *args)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_alone)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", [module, *arguments])
    with pytest.raises(Parsed):
        runpy.run_module(module, run_name="__main__", alter_sys=False)


@pytest.fixture
def run_block(tmp_path, monkeypatch):
    """Runs a Python block as a program of its own, in an empty folder."""

    def run(block: str) -> None:
        (tmp_path / "documented.py").write_text(block)
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "documented", raising=False)
        importlib.import_module("documented")

    return run


@pytest.mark.slow
@pytest.mark.parametrize("block", PYTHON)
def test_python_blocks_run(block, run_block):
    run_block(block)


def test_every_name_of_the_public_api_exists():
    page = (DOCS / "reference" / "public-api.md").read_text()
    names = set(re.findall(r"`((?:clear_strategies|rasterizers|integration)\.[\w.]+)`", page)) - {OPTIONS}
    assert {f"clear_strategies.{name}" for name in clear_strategies.__all__} <= names | {
        "clear_strategies.ATTRIBUTES", "clear_strategies.CONFLICT_GROUPS",
    }  # fmt: skip
    for module, _, name in (whole.rpartition(".") for whole in names):
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


@pytest.mark.slow
def test_the_notebook_runs(run_block):
    cells = json.loads((DOCS / "tutorial" / "notebook.ipynb").read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] for cell in cells if cell["cell_type"] == "code")  # python docs/figures.py notebook
    run_block("\n".join(code).replace("fit.iterations=300", "fit.iterations=30"))


@pytest.mark.slow
def test_the_readmes_loop_prints_the_number_of_its_table(run_block, capsys):
    run_block(README_LOOP)
    printed = float(capsys.readouterr().out.removesuffix(" dB\n"))
    (shown,) = re.findall(
        r'^\| with `conductor\("best"\)` \| ([\d.]+) dB', (ROOT / "README.md").read_text(), re.MULTILINE
    )
    assert printed == pytest.approx(float(shown), abs=0.15)


def test_the_readmes_blocks_are_as_short_as_promised():
    loop, gco = (
        [line for line in block.splitlines() if line.strip()] for block in blocks(ROOT / "README.md", "python")
    )
    assert len(loop) <= 25
    assert len(gco) <= 10
    assert all(len(line) <= 120 for line in loop + gco)


# Commands of the README and the guides that no test runs, and why; `test_commands_are_understood` reads all of them.
NOT_RUN = {
    "the reader's scenes": r"FOLDER|scenes/|multirun/",
    "another trainer": r"-m integration\.(gsplat|inria) |^ns-train",
    "installation, the gate": r"^(python3? -m (venv|build|pytest)|cibuildwheel|pip install)\b",
    "other programs": r"^(for|done|wait|tensorboard)\b",
    "an environment": r"^\. ",
    "waits for a browser": r"^clear-strategies view",
    "a video whose poses take a minute; tests/data/readers/test_video.py reads one": r"^clear-strategies train clip\.mp4",
    "needs Node.js": r" --to (spz|html)",
    "takes minutes, or a file that the viewer saves": r"--frames 240|flight\.json",
    "a class that the reader names": r"YourStrategy",
    "a wheel's first run, in the gate": r"^clear-strategies \+strategy=clear fit.iterations=10$",
}


def followed(page: Path) -> list[list[str]]:
    """The commands of a guide that can be run here, each by the first guide that has it."""
    lines = {" ".join(words): words for block in blocks(page, "sh") for words in commands(block)}
    known = {line for earlier in FOLLOWED.values() for line in map(" ".join, earlier)}
    return [
        words
        for line, words in lines.items()
        if line not in known and not any(re.search(why, line) for why in NOT_RUN.values())
    ]


FOLLOWED: dict[Path, list[list[str]]] = {}
for guide in [ROOT / "README.md", *sorted((DOCS / "how-to").glob("*.md"))]:
    FOLLOWED[guide] = followed(guide)


def follow(lines: list[list[str]], folder: Path) -> None:
    """Run documented commands in a folder, one after the other; a training is a tiny one, and draws no pictures."""
    done = command_line.run(json.dumps(lines), cwd=folder, module="tests.helpers.documented")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page, lines in FOLLOWED.items() if lines], ids=name)
def test_commands_of_the_guides_run(page, tmp_path):
    (tmp_path / f"{documented.PACKAGE}.py").write_text("".join(blocks(page, "python")[:1]))
    follow(FOLLOWED[page], tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        if target.startswith("http"):
            continue
        path = (page.parent / target).resolve()
        generated = path.is_relative_to(DOCS) and path.relative_to(DOCS).as_posix() in HOOKS.GENERATED
        assert path.exists() or generated, target


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_paths_that_pages_name_exist(page):
    text = page.read_text()
    named = re.findall(r"`((?:clear_strategies|rasterizers|integration|conf|tests|docs)/[\w./-]*)`", text)
    for folder, rows in re.findall(r"^\| file of `([^`]+)` \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", text, re.MULTILINE):
        cells = [row.split("|")[1] for row in rows.splitlines()]
        named += [f"{folder}/{file}" for cell in cells for file in re.findall(r"`([^`]+)`", cell)]
    assert not [path for path in named if not (ROOT / path).exists()]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_symbols_that_pages_name_are_in_their_files(page):
    stations = re.findall(r"`([\w./-]+\.(?:py|cpp|hpp|yaml|md)):([\w.]+)`", page.read_text())
    assert stations or page.name != "CONTRIBUTING.md"
    assert not [f"{file}:{symbol}" for file, symbol in stations if not holds(ROOT / file, symbol)]


def holds(file: Path, symbol: str) -> bool:
    """Whether a file defines a symbol; one that is not Python, whether it has the word."""
    if file.suffix != ".py":
        return file.is_file() and re.search(rf"\b{symbol}\b", file.read_text()) is not None
    body = ast.parse(file.read_text()).body if file.is_file() else []
    for part in symbol.split("."):
        defined = next((node for node in body if part in names_of(node)), None)
        if defined is None:
            return False
        body = getattr(defined, "body", [])
    return True


def names_of(node: ast.stmt) -> set[str]:
    targets = [*getattr(node, "targets", []), getattr(node, "target", None)]
    return {getattr(node, "name", ""), *(target.id for target in targets if isinstance(target, ast.Name))}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_names_that_pages_use_exist(page):
    named = re.findall(rf"`((?:{'|'.join(OURS)})(?:\.\w+)+)", page.read_text())
    assert not [dotted for dotted in dict.fromkeys(named) if not exists(dotted)]


def exists(dotted: str) -> bool:
    parts = dotted.split(".")
    for n in range(len(parts), 0, -1):
        file = ROOT.joinpath(*parts[:n])
        source = file.with_suffix(".py") if file.with_suffix(".py").is_file() else file / "__init__.py"
        if not source.is_file():
            continue
        try:
            found: object = importlib.import_module(".".join(parts[:n]))
            for part in parts[n:]:
                found = getattr(found, part)
        except AttributeError:
            return False
        except ImportError:  # a host's own module is not installed
            tree = ast.parse(source.read_text())
            return {getattr(node, "name", None) for node in tree.body} >= set(parts[n : n + 1])
        return True
    return False


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


def test_the_readme_has_the_two_commands_of_the_gate():
    assert len(blocks(ROOT / "README.md", "bash")) == 2
    assert len((ROOT / "README.md").read_text().splitlines()) <= 160


@cache
def composed() -> DictConfig:
    return loader().load_configuration("config", ["+strategy=clear"], run_mode=RunMode.RUN)


@pytest.mark.slow
def test_the_first_tutorial_works(tmp_path):
    page = blocks(DOCS / "tutorial" / "first-scene.md", "sh")
    followed = [words for block in page for words in commands(block) if words[:2] == ["python", "-m"]]
    assert len(followed) > 5
    follow(followed, tmp_path)
    assert (tmp_path / "outputs" / "compared" / "report.html").is_file()


@pytest.fixture(scope="module")
def first_run(tmp_path_factory) -> tuple[Path, str]:
    """The README's first run as a tiny one: its folder, and what it printed."""
    *_, first = commands(blocks(ROOT / "README.md", "bash")[0])
    assert first[:3] == ["python", "-m", "clear_strategies.run"]
    folder = tmp_path_factory.mktemp("first")
    tiny = ["fit.iterations=10", "data.reader.width=96", "data.reader.height=64"]
    done = command_line.run(*first[3:], *tiny, f"hydra.run.dir={folder}", cwd=folder, drawn=True)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.mark.slow
def test_the_readmes_first_run_leaves_the_files_that_the_reference_lists(first_run):
    folder, printed = first_run
    for block in blocks(DOCS / "tutorial" / "first-scene.md", "text"):
        assert not set(map(without_numbers, block.splitlines())) - set(map(without_numbers, printed.splitlines()))
    table = (DOCS / "reference" / "files.md").read_text().split("`run.lock`")[0]
    listed = [
        re.sub(r"NAME|N+", "*", path) + ("*" if path.endswith("/") else "")
        for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
        for path in re.findall(r"`([^`]+)`", row)
    ]
    files = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file() and path.name != "run.lock"]
    written = [path.as_posix() for path in files if path.parts[0] != "cache"]  # of this test's own
    assert not [path for path in written if not any(fnmatch.fnmatch(path, pattern) for pattern in listed)]
    assert not [pattern for pattern in listed if not any(fnmatch.fnmatch(path, pattern) for path in written)]


def without_numbers(line: str) -> str:
    """The line with `#` for each number and FOLDER for the path at its end; numbers may differ in width."""
    line = re.sub(r": \S*/\S*$", ": FOLDER", line)
    return " ".join(re.sub(r"[+-]?\d[\d.,]*", "#", line).split())


@pytest.mark.slow
def test_the_readmes_picture_is_drawn_from_a_run_of_the_demo(first_run, tmp_path):
    loaded(DOCS / "figures.py").readme_picture(first_run[0], tmp_path / "demo.png")
    with Image.open(tmp_path / "demo.png") as picture, Image.open(DOCS / "images" / "demo.png") as shown:
        assert picture.width > picture.height
        assert shown.format == "PNG"


def test_what_has_not_run_on_a_gpu_is_said_once():
    claim = re.compile(
        r"not (?:yet )?(?:been )?(?:run|on)\b[^.]{0,40}\bGPU|not yet run|on a GPU not yet", re.IGNORECASE
    )
    elsewhere = [page for page in PAGES if page.name not in ("status.md", "benchmarks.md")]
    assert not [name(page) for page in elsewhere if claim.search(" ".join(page.read_text().split()))]
    assert "yet" in (DOCS / "status.md").read_text()


def test_every_reading_of_the_method_is_listed():
    rows = re.findall(r"^\| F(\d+) \|", (DOCS / "explanation" / "paper.md").read_text(), re.MULTILINE)
    assert [int(row) for row in rows] == list(range(1, 47))


def test_every_test_that_the_paper_page_names_exists():
    equations = (DOCS / "explanation" / "paper.md").read_text().split("## Readings")[0]
    named = set(re.findall(r"`(test_\w+)`", equations))
    source = "".join(p.read_text() for p in (ROOT / "tests").rglob("test_*.py"))
    assert named
    assert not {test for test in named if f"def {test}(" not in source}


def test_config_fields_that_pages_name_exist():
    groups = "data|strategies|decorators|objective|density|optim|mip|rasterizer|fit|skips"
    for page in PAGES:
        today = re.sub(r"\n### Breaking\n.*?\n### ", "", page.read_text(), flags=re.DOTALL)  # it names what is gone
        # "strategies.svs.anchor_strength=0" and "fit.resume=…" name a field, too
        for field in re.findall(rf"`((?:{groups})\.[\w.]+)(?:=[^`]*)?`", today):
            if field.startswith(("density.strategy", "objective.kernels", "skips.hr")) or "mine" in field:
                continue
            assert exists_in_config(field), f"{name(page)}: {field}"
    readings = (DOCS / "explanation" / "paper.md").read_text().split("## Readings")[1]
    assert len(re.findall(rf"`(?:{groups})\.[\w.]+`", readings)) > 20


def exists_in_config(field: str) -> bool:
    """In the composed configuration, in a file of conf/, or in the class that the configuration names."""
    return OmegaConf.select(composed(), field, default="absent", throw_on_missing=False) != "absent" or field in FIELDS


def fields_of_files() -> Iterator[str]:
    """Every dotted key that a file of conf/ sets."""

    def keys(prefix: str, node: DictConfig) -> Iterator[str]:
        for key, value in node.items_ex(resolve=False):
            yield f"{prefix}{key}"
            if isinstance(value, DictConfig):
                yield from keys(f"{prefix}{key}.", value)

    for path in CONF.rglob("*.yaml"):
        package = re.search(r"^# @package (\S+)", path.read_text(), re.MULTILINE)
        here = package[1] if package else ".".join(path.parent.relative_to(CONF).parts)
        yield from keys("" if here in ("", "_global_") else f"{here}.", OmegaConf.load(path))


GROUPS = HOOKS.groups()
FIELDS = {
    *(
        f"{section.key}.{setting.name}"
        for group in GROUPS
        for section in group.sections
        for setting in section.settings
    ),
    *(section.key for group in GROUPS for section in group.sections),
    *fields_of_files(),
}

# Fields that neither a docstring nor a comment describes. Describe them; nothing may be added here.


def test_every_field_of_the_configuration_is_described():
    assert HOOKS.undescribed(GROUPS) == []


def test_the_configuration_page_lists_every_choice_and_every_setting():
    page = HOOKS.page(GROUPS)
    for path in CONF.rglob("*.yaml"):
        if not path.stem.startswith("_") and path.parent != CONF:
            assert f"| `{path.stem}` |" in page, path
    assert len(FIELDS) > 100


def test_the_architecture_page_shows_the_floors():
    from tests.helpers.floors import DOORS, FLOORS

    def rows(after: str) -> list[list[set[str]]]:
        text = (DOCS / "explanation" / "architecture.md").read_text().split(after)[1].split("\n\n")[0]
        return [
            [set(re.findall(r"`([^`]+)`", cell)) for cell in line.split("|")[1:-1]]
            for line in text.splitlines()
            if line.startswith("| `")
        ]

    floors = {min(folder): (imports, libraries) for folder, _, imports, libraries in rows("| folder or file |")}
    assert floors == FLOORS
    assert list(floors) == list(FLOORS)
    assert {min(door): libraries for door, libraries in rows("| door |")} == DOORS


def test_the_table_of_hooks_shows_the_hooks_of_a_strategy():
    page = (DOCS / "how-to" / "own-strategy.md").read_text()
    rows = re.findall(r"^\| `(\w+)\(([^)]*)\)`", page, re.MULTILINE)
    shown = {hook: arguments.split(", ") if arguments else [] for hook, arguments in rows}
    hooks = {hook: list(inspect.signature(getattr(Strategy, hook)).parameters)[1:] for hook in shown}
    assert shown == hooks
    assert len(shown) == 14


def test_pictures_are_drawn_from_the_tables(tmp_path):
    figures = loaded(DOCS / "figures.py")
    figures.main(tmp_path)
    page = (DOCS / "explanation" / "evidence-sparse.md").read_text()
    named = set(re.findall(r"images/(evidence_\w+\.svg)", page))
    assert named == {path.name for path in tmp_path.iterdir()}
    assert all((DOCS / "images" / picture).exists() for picture in named)


def test_the_gains_that_the_readme_names_are_those_of_the_evidence():
    text = (ROOT / "README.md").read_text()
    table = re.search(r"^\| what you add .*\n\|[-|]+\|\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert table
    gains = set(re.findall(r"\+\d\.\d+", table[1]))
    assert len(gains) == 4
    assert not [gain for gain in gains if f"{gain[1:]}" not in (DOCS / "explanation" / "evidence.md").read_text()]


def test_numbers_of_a_summary_are_those_of_its_table():
    """Every row of a small table on the evidence pages stands in the CSV file that is linked below it."""
    page = "".join(
        (DOCS / "explanation" / name).read_text() for name in ("evidence.md", "evidence-sparse.md", "evidence-hosts.md")
    )
    checked = 0
    for section in page.split("\n## ")[1:]:
        table = re.search(r"^\|.*\n\|[-|]+\|\n((?:\|.*\n)+)", section, re.MULTILINE)
        linked = re.search(r"\]\(\.\./data/evidence/(\w+\.csv)\)", section)
        if table is None or linked is None:
            continue
        numbers = r"(?<![\w.])[+-]?\d[\d,]*\.?\d*(?![\w.]*[A-Za-z])"
        with (DOCS / "data" / "evidence" / linked[1]).open(newline="") as file:
            known = {number for row in csv.reader(file) for cell in row for number in re.findall(numbers, cell)}
        for row in table[1].splitlines():
            cells = row.replace("*", "").split("|")[2:]
            assert not set(re.findall(numbers, " | ".join(cells))) - known, row
            checked += 1
    assert checked > 30


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    page = (tmp_path / "site" / "reference" / "strategies.html").read_text()
    assert "regularize" in page
