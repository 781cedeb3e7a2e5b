"""docs/template, a package with a strategy of its own, works when it is installed."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path

import pytest

import clear_strategies as cs
from clear_strategies.compose import OPTIONS, conductor
from clear_strategies.errors import SettingError
from tests.helpers.command_line import TINY

TEMPLATE = Path(__file__).resolve().parents[1] / "docs" / "template"


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, points: dict[str, str]) -> None:
    """What pip leaves for a package with these entry points."""
    info = folder / "clear_veto-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: clear-veto\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(f"[{OPTIONS}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()))
    monkeypatch.syspath_prepend(folder)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((TEMPLATE / "pyproject.toml").read_text())["project"]
    install(tmp_path / "site", monkeypatch, project["entry-points"][OPTIONS])
    monkeypatch.syspath_prepend(TEMPLATE)


def test_its_own_tests_pass(installed: None) -> None:
    spec = importlib.util.spec_from_file_location("test_veto", TEMPLATE / "tests" / "test_veto.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    tests = [getattr(module, name) for name in dir(module) if name.startswith("test_")]
    assert len(tests) == 2
    for test in tests:
        test()


def test_it_trains_by_its_name_and_composes_with_others(installed: None, tmp_path: Path) -> None:
    of_veto = ("+strategy=[veto,svs]", "strategies.veto.start=5", "prior=bicubic")
    run = cs.train(None, *TINY, *of_veto, folder=tmp_path / "run")
    assert run.metrics["strategies"] == ["veto", "svs"]
    assert run.metrics["config"]["strategies.veto.start"] == 5
    (veto, _) = conductor("veto,svs", iterations=1_000).strategies
    assert (type(veto).__name__, veto.start) == ("Veto", 200)


def test_an_entry_point_without_a_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, {"lost": "nowhere.conf"})
    with pytest.raises(SettingError, match=r"lost = 'nowhere.conf'.*pip show -f clear-veto"):
        conductor("clear")
