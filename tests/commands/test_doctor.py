"""`clear-strategies doctor` says what is here, what is missing, and which backend draws something wrong."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

import rasterizers
from clear_strategies.commands import doctor
from clear_strategies.errors import SettingError

ROOT = Path(__file__).resolve().parents[2]


def test_it_names_versions_memory_backends_and_missing_extras_with_what_they_add(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name == "pycolmap" else object())
    doctor.main([])
    said = capsys.readouterr().out
    for word in ("python", "torch", "processor", "memory", "rasterizers", "SR images"):
        assert word in said
    assert "torch                   works: differs from the reference by 0.0e+00" in said
    assert "poses for photos without any (data=photos): pip install 'clear-strategies[colmap]' (lacks pycolmap)" in said


def test_a_backend_that_draws_something_else_is_an_error(capsys, monkeypatch):
    load = rasterizers.load

    def darker(name, **settings):
        return load(name, **settings) if name != "torch" or "alpha_max" in settings else load(name, alpha_max=0.3)

    reference = load("torch", preset="accurate")
    monkeypatch.setattr(rasterizers, "names", lambda: ["torch"])
    calls = iter([reference])
    monkeypatch.setattr(rasterizers, "load", lambda name, **s: next(calls, None) or darker(name))
    with pytest.raises(SettingError, match="torch draws something else than the reference"):
        doctor.main([])
    assert "WRONG" in capsys.readouterr().out


def test_every_extra_is_one_of_the_projects():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(doctor.EXTRAS) == set(extras) - {"photos", "docs", "dev"}
