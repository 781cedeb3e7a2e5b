"""What the documentation says runs, and what it points to exists."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "integration" / "README.md"]
BLOCKS = [
    pytest.param(block, id=f"{page.name}-{i}")
    for page in PAGES
    for i, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
]


@pytest.mark.parametrize("block", BLOCKS)
def test_python_blocks_run(block, tmp_path, monkeypatch):
    (tmp_path / "documented.py").write_text(block)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "documented", raising=False)
    importlib.import_module("documented")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_every_reading_of_the_method_is_listed():
    rows = re.findall(r"^\| F(\d+) \|", (ROOT / "docs" / "paper.md").read_text(), re.MULTILINE)
    assert [int(row) for row in rows] == list(range(1, 47))


def test_every_test_that_the_paper_page_names_exists():
    equations = (ROOT / "docs" / "paper.md").read_text().split("## Readings")[0]
    named = set(re.findall(r"`(test_\w+)`", equations))
    source = "".join(p.read_text() for p in (ROOT / "tests").rglob("test_*.py"))
    assert named
    assert not {name for name in named if f"def {name}(" not in source}


def test_config_fields_that_the_paper_page_names_exist():
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from clear_strategies.run import CONF

    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", ["+strategy=clear"])
    pattern = r"`((?:data|strategies|objective|density|optim|mip|rasterizer|fit)\.[\w.]+)`"
    readings = (ROOT / "docs" / "paper.md").read_text().split("## Readings")[1]
    assert len(re.findall(pattern, readings)) > 20
    for field in re.findall(pattern, readings):
        assert OmegaConf.select(config, field, default="absent") != "absent", field
