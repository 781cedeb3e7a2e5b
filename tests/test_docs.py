"""What the documentation says runs: its commands, its Python, its tutorials. tests/test_doc_names.py checks what it names."""

import argparse
import ast
import fnmatch
import importlib
import importlib.util
import json
import re
import runpy
import signal
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock, Mock

import pytest
import torch
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig
from PIL import Image

from clear_strategies import Conductor, Objective, Photo
from clear_strategies.commands import train
from clear_strategies.files import write_text
from clear_strategies.options import CONF
from clear_strategies.training import loop
from tests.helpers import command_line, documented, short_run, toy
from tests.helpers.compiled_step_cases import ALWAYS
from tests.helpers.configs import composed, jobs_of, loader
from tests.helpers.pages import DOCS, OURS, PAGES, ROOT, blocks, commands, loaded, name

# Each command once, by the first page that has it.
COMMANDS = {
    " ".join(words): pytest.param(words, id=f"{name(page)}: {' '.join(words)[:60]}")
    for page in reversed(PAGES)
    for block in blocks(page, "sh", "bash")
    for words in commands(block)
}.values()
PYTHON = [
    pytest.param(block, id=f"{name(page)}-{i}") for page in PAGES for i, block in enumerate(blocks(page, "python"))
]
# Commands of other programs: nothing of them is checked, but that extras exist.
FOREIGN = (
    r"(python3? -m (venv|pip|build)|cibuildwheel|\.|pip install|for|done|wait|ns-train|mkdocs|pre-commit|cd"
    r"|git clone|sed|eval) ?"
)

TAKEN: set[str] = set()  # words that chose a file for a job of a sweep, of any command
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
    assert set(flags) <= {"-m", "--cfg", "job", "--resolve"}, flags
    if "-m" not in flags and not any(word.startswith("experiment=") for word in overrides):
        require_conductor(composed(*overrides))
        return
    whole = loader().load_configuration("config", overrides, run_mode=RunMode.MULTIRUN, validate_sweep_overrides=False)
    for i, job in enumerate(jobs_of(whole, overrides)):
        files = {word for word in job if (CONF / word.lstrip("+").split("=")[0]).is_dir()}
        if i == 0 or files - TAKEN:  # the first job, and each that takes a file that no job before it took
            TAKEN.update(files)
            require_conductor(loader().load_sweep_config(whole, list(job)))


def require_conductor(config: DictConfig) -> None:
    targets = [str(node.get("_target_")) for node in (config.objective, *config.strategies.values())]
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

    def run(block: str) -> ModuleType:
        (tmp_path / "documented.py").write_text(block)
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "documented", raising=False)
        return importlib.import_module("documented")

    return run


def test_options_begin_with_their_package_which_hydra_reads_nowhere_else():
    options_shown = [b for page in PAGES for b in blocks(page, "yaml") if "@package" in b]
    assert len(options_shown) >= 2
    assert all(block.startswith("# @package ") for block in options_shown)


@pytest.mark.slow
@pytest.mark.parametrize("block", PYTHON)
def test_python_blocks_run(block, run_block):
    run_block(block)


@pytest.mark.slow
def test_the_notebook_runs_and_has_saved_what_it_shows(tmp_path):
    """`python docs/figures.py notebook` saves it anew."""
    cells = json.loads((DOCS / "tutorial" / "notebook.ipynb").read_text())["cells"]
    code = {"".join(cell["source"]): cell["outputs"] for cell in cells if cell["cell_type"] == "code"}
    told = "import json\nprint(json.dumps([run.metrics['test']['mean']['ours'], {k: x.shape for k, x in run.splats.items()}]))"
    done = command_line.run(cwd=tmp_path, code="\n".join([*code, told]))
    assert done.returncode == 0, done.stderr
    found, splats = json.loads(done.stdout.splitlines()[-1])
    scores, shapes = (
        ast.literal_eval("".join(outputs[0]["data"]["text/plain"]))
        for source, outputs in code.items()
        if source.startswith(("run.metrics", "{name: "))
    )
    # Processors round differently: with AVX2 the run ends 0.18 dB, and 6 % of the Gaussians, above what AVX-512 has saved.
    assert found.pop("psnr") == pytest.approx(scores.pop("psnr"), abs=0.25)
    assert found == pytest.approx(scores, abs=0.01)
    assert {name: shape[1:] for name, shape in splats.items()} == {name: [*shape[1:]] for name, shape in shapes.items()}
    assert splats["means"][0] == pytest.approx(shapes["means"][0], rel=0.08)


def test_the_guides_loss_and_densifier_train_as_they_say(run_block):
    found = {}
    for block in blocks(DOCS / "how-to" / "own-strategy.md", "python"):
        if "Spectrum" in block or "ByBudget" in block or "Exposures" in block:
            found |= vars(run_block(block))
    spectrum, exposures = found["Spectrum"](start=0), found["Exposures"]()
    state = short_run.start(
        (), more=[found["Compact"](), spectrum, exposures, found["Budget"](budget=30, every=2, stop=12)]
    )
    objective = state.conductor.objective = Objective(lambda_hr=ALWAYS)
    shown = torch.arange(16 * 16).view(16, 16) % 3 > 0
    image, target = torch.rand(2, 16, 16, 3)
    photo = Photo(toy.camera(0, 16, 16), target, shown)
    compared = spectrum.compare("hr", image, photo, toy.step(), lambda image: objective.hr(image, target, shown))
    assert not compared.cotangents[0][~shown].any()
    n = len(state.field)
    while state.t <= 12:
        loop.iterate(state, toy.RASTERIZER)
    assert (n, len(state.field)) == (16, 30)
    assert all(row["loss_spectrum"] > 0 for row in state.history_as_floats())
    gains = exposures.run_state["gains"]
    assert ((gains != 1) & ((gains - 1).abs() < 0.1)).all()


def test_the_guides_reader_reads_a_folder_and_train_chooses_it_in_a_folder_of_options(tmp_path, monkeypatch):
    (block,) = blocks(DOCS / "how-to" / "own-reader.md", "python")
    (tmp_path / "your_package.py").write_text(block)
    (option,) = blocks(DOCS / "how-to" / "own-reader.md", "yaml")
    write_text(tmp_path / "conf" / "data" / "mine.yaml", option)
    monkeypatch.syspath_prepend(tmp_path)
    for i in range(3):
        Image.new("RGB", (24, 16), (80 * i, 0, 0)).save(tmp_path / f"{i}.png")
    rows = "".join(f"{i}.png,24,16,30,30,{i},0,-2\n" for i in range(3))
    (tmp_path / "poses.csv").write_text(f"file,width,height,fx,fy,x,y,z\n{rows}")
    for flags in (["--config-dir", "conf"], ["--config-dir=elsewhere", "-cd=conf"]):
        monkeypatch.chdir(tmp_path)
        assert "data=mine" in train.overrides([".", "fit.seed=1", *flags])
    capture = importlib.import_module("your_package").read(tmp_path)
    assert [frame.name for frame in capture.frames] == ["0.png", "1.png", "2.png"]
    assert capture.frames[2].camera.center.tolist() == [2, 0, -2]
    assert capture.frames[2].load().image[0, 0].tolist() == pytest.approx([160 / 255, 0, 0])


@pytest.mark.slow
def test_the_readmes_loop_prints_the_number_of_its_table(tmp_path):
    pytest.importorskip("gsplat")
    (shown,) = re.findall(
        r"^\| `--strategies best` \| \**([\d.]+) ± [\d.]+ dB", (ROOT / "README.md").read_text(), re.MULTILINE
    )
    done = command_line.run("--strategies", "best", cwd=tmp_path, module="integration.examples.gsplat_loop")
    assert float(done.stdout.split()[1]) == pytest.approx(float(shown), abs=0.15), done.stderr


def test_the_readmes_loop_does_not_prune_by_size(monkeypatch):
    """DefaultStrategy does from `reset_every` on, in units of the scene: half of the demo's first Gaussians would go."""
    gsplat_loop = pytest.importorskip("integration.examples.gsplat_loop")
    strategy = Mock(side_effect=StopIteration)
    monkeypatch.setattr(gsplat_loop, "DefaultStrategy", strategy)
    for first in ("load_demo", "stereo"):
        monkeypatch.setattr(gsplat_loop, first, MagicMock())
    monkeypatch.setattr(gsplat_loop, "splats_with_optimizers", lambda *_: ({}, {}))
    with pytest.raises(StopIteration):
        gsplat_loop.train(30_000, "best")
    assert strategy.call_args.kwargs["reset_every"] >= strategy.call_args.kwargs["refine_stop_iter"]


def test_the_readmes_diff_stands_in_the_example():
    (diff,) = blocks(ROOT / "README.md", "diff")
    added = "".join(line[1:] for line in diff.splitlines() if line.startswith("+"))
    example = (ROOT / "integration/examples/gsplat_loop.py").read_text()
    marked = "".join(line.partition("#")[0].strip() for line in example.splitlines() if line.endswith("# +"))
    renamed = {"strategies,": '"best",', ", seed=seed": "", "attached = ": "rasterization = "}
    for there, here in (renamed | {"rasterization = attached": ""}).items():
        marked = marked.replace(there, here)
    assert marked == added


# Commands of the README and the guides that no test runs, and why; `test_commands_are_understood` reads all of them.
NOT_RUN = {
    "the reader's scenes": r"FOLDER|scenes/|multirun/",
    "another trainer": r"-m integration\.(gsplat|inria|on_cpu) |^ns-train",
    "installation, the gate": r"^(python3? -m (venv|build|pytest)|cibuildwheel|pip install)\b",
    "other programs": r"^(for|done|wait|sed|eval|git|cd)\b",
    "an environment": r"^\. ",
    "waits for a browser": r"^clear-strategies view",
    "takes minutes, or a file that the viewer saves": r"--frames 240|flight\.json",
    "a class that the reader names": r"YourStrategy",
}


# The commands of the guides that a test runs, each by the first guide that has it.
FOLLOWED: dict[str, tuple[Path, list[str]]] = {}
for guide in [ROOT / "README.md", *sorted((DOCS / "how-to").glob("*.md"))]:
    for words in (words for block in blocks(guide, "sh") for words in commands(block)):
        if not any(re.search(why, " ".join(words)) for why in NOT_RUN.values()):
            FOLLOWED.setdefault(" ".join(words), (guide, words))


def follow(lines: list[list[str]], folder: Path) -> None:
    """Run documented commands in a folder, one after the other; a training is a tiny one, and draws no pictures."""
    done = command_line.run(json.dumps(lines), cwd=folder, module="tests.helpers.documented")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


@pytest.mark.slow
@pytest.mark.parametrize("page", dict.fromkeys(guide for guide, _ in FOLLOWED.values()), ids=name)
def test_commands_of_the_guides_run(page, tmp_path):
    (tmp_path / f"{documented.PACKAGE}.py").write_text("\n".join(blocks(page, "python")))
    follow([words for guide, words in FOLLOWED.values() if guide == page], tmp_path)


@pytest.mark.slow
def test_the_first_tutorial_works(tmp_path):
    page = blocks(DOCS / "tutorial" / "first-scene.md", "sh")
    lines = [words for block in page for words in commands(block) if "outputs/demo/" not in " ".join(words)]
    assert len(lines) > 4
    follow(lines, tmp_path)
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
    """The line with `#` for each number and FOLDER for the path at its end; numbers may differ in width, and short stages are not
    told.
    """
    line = re.sub(r"^(done in [^(:]*) \(.*\)", r"\1", line)
    line = re.sub(r": \S*/\S*$", ": FOLDER", line)
    return " ".join(re.sub(r"[+-]?\d[\d.,]*", "#", line).split())


@pytest.mark.slow
def test_the_readmes_picture_is_drawn_from_a_run_of_the_demo(first_run, tmp_path):
    loaded(DOCS / "figures.py").readme_picture(first_run[0], first_run[0], tmp_path / "demo.png")
    with Image.open(tmp_path / "demo.png") as picture, Image.open(DOCS / "images" / "demo.png") as shown:
        assert picture.width > picture.height
        assert shown.format == "PNG"
