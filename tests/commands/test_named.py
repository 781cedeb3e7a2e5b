"""What the first word of a command line does: a subcommand, help, Hydra, or an error that names what was meant; and `doctor`."""

import argparse
import os
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import partial
from importlib import metadata

import pytest
from hydra._internal.utils import get_args_parser

import rasterizers
from clear_strategies import hydra_app, run
from clear_strategies.commands import doctor
from clear_strategies.errors import SettingError
from rasterizers import gsplat_backend
from tests.helpers import command_line
from tests.helpers.paths import ROOT

SLOW = ("hydra", "numpy", "omegaconf", "torch")


@pytest.mark.parametrize("arguments", [[], ["help"], ["--help"], ["-h"]], ids=" ".join)
def test_help_lists_the_commands_and_then_where_research_begins(arguments, capsys):
    run.named(arguments)()
    said = capsys.readouterr().out
    rows = [line.split()[0] for line in said.splitlines() if line.startswith("  ")]
    assert rows[: len(run.NAMES)] == run.NAMES
    for word in ("+strategy=clear", "-m ", "--cfg job", "--hydra-help"):
        assert word in said[said.index("research") :]


@pytest.mark.parametrize("arguments", [["--version"], ["train", "--version"], ["+strategy=clear", "--version"]])
def test_the_version_is_this_packages_and_not_hydras(arguments, capsys):
    run.named(arguments)()
    assert capsys.readouterr().out == f"clear-strategies {metadata.version('clear-strategies')}\n"


@pytest.mark.parametrize("first", ["+strategy=clear", "fit.iterations=3", "~data.reader.width", "-m", "--cfg", "-v"])
def test_overrides_and_flags_are_hydras(first, monkeypatch):
    called = list[str]()
    monkeypatch.setattr(hydra_app, "main", lambda: called.append(first))
    run.named([first, "more"])()
    assert called == [first]


def test_flags_are_those_of_hydra_where_argparse_checks_their_help(monkeypatch):
    """As Python 3.14's does, which refuses Hydra 1.3."""
    add = argparse._ActionsContainer.add_argument

    def check(self, action):
        if action.help and not isinstance(action.help, str):
            raise ValueError("badly formed help string")

    def checked(self, *names, **settings):
        action = add(self, *names, **settings)
        self._check_help(action)
        return action

    monkeypatch.setattr(argparse._ActionsContainer, "_check_help", check, raising=False)
    monkeypatch.setattr(argparse._ActionsContainer, "add_argument", checked)
    with pytest.raises(ValueError, match="badly formed help string"):
        get_args_parser()
    with hydra_app.help_unchecked(), hydra_app.help_unchecked():
        assert get_args_parser().parse_args(["-m", "a=1,2"]).multirun
    with pytest.raises(ValueError, match="badly formed help string"):
        argparse.ArgumentParser().add_argument("--own", help=object())


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("Train", "Did you mean train?"),
        ("photos/", "Did you mean clear-strategies train photos/?"),
        ("my photos/", "Did you mean clear-strategies train 'my photos/'?"),
        ("~/photos", "Did you mean clear-strategies train '~/photos'?"),  # in quotes, which no shell expands
        ("views", "Did you mean clear-strategies train views?"),  # a folder that is there
        ("point_cloud.ply", "Did you mean clear-strategies view point_cloud.ply?"),
        ("report", "Did you mean python -m clear_strategies.report?"),
        ("fit.iterations", "clear-strategies --help lists all; a setting is written name=value."),
    ],
)
def test_another_word_is_refused_with_what_was_meant(word, meant, tmp_path, monkeypatch):
    (tmp_path / "views").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingError) as refused:
        run.named([word, "kit"])
    assert str(refused.value) == f"{word}: there is no such command. {meant}"


QUICK = {
    "": 0, "--help": 0, **{f"{name} --help": 0 for name in run.NAMES}, "trian kit": 2, "photos/": 2,
    "train nowhere": 2, "render": 2, "export run --sh nothing": 2,
}  # fmt: skip
REPORTED = f"""
import sys
from clear_strategies.run import main
for line in sys.argv[1:]:
    sys.argv[1:], code = line.split(), 0
    try:
        main()
    except SystemExit as end:
        code = end.code
    print("ended", line, code, sorted(sys.modules.keys() & set({SLOW!r})))
"""


def test_help_and_wrong_words_wait_for_neither_torch_nor_hydra(tmp_path):
    result = subprocess.run(
        [sys.executable, "-c", REPORTED, *QUICK], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    ended = [line for line in result.stdout.splitlines() if line.startswith("ended")]
    assert ended == [f"ended {line} {code} []" for line, code in QUICK.items()], result.stderr
    assert result.stderr.count("\n") == sum(map(bool, QUICK.values())), result.stderr


@pytest.mark.parametrize("line", ["clear-strategies fit.itera", "clear-strategies train photos fit.itera"])
def test_the_shell_completes_settings_also_behind_train(line, tmp_path):
    completing = {"COMP_LINE": line, "COMP_POINT": str(len(line))}
    code = f"import os\nos.environ |= {completing}\nfrom clear_strategies.hydra_app import main\nmain()"
    ended = command_line.run("-sc", "query=bash", cwd=tmp_path, code=code)
    assert ended.stdout.split() == ["fit.iterations="], ended.stderr


def test_flags_stand_anywhere_between_settings(tmp_path):
    said = command_line.run("+strategy=gco", "--cfg", "job", "-v", "fit.seed=3", cwd=tmp_path).stdout
    assert {"  seed: 3", "  verbose: true"} <= {*said.splitlines()}


# ---- `clear-strategies doctor` says what is here, what is missing, and which backend draws something wrong
def test_doctor_names_versions_memory_backends_and_missing_extras(capsys, monkeypatch) -> None:
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name == "pycolmap" else object())
    doctor.main([])
    said = capsys.readouterr().out
    for word in ("python", "torch", "processor", "memory", "rasterizers", "SR images"):
        assert word in said
    assert f"{'torch':32}works: differs from the reference by 0.0e+00" in said
    assert "poses for photos without any (data=photos): pip install 'clear-strategies[colmap]' (lacks pycolmap)" in said
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(doctor.EXTRAS) == set(extras) - {"photos", "docs", "dev"}


def test_gsplat_which_has_cut_offs_of_its_own_alone_is_tested_by_them(capsys, monkeypatch):
    ours, on_cpu = partial(rasterizers.rasterization, backend="torch"), frozenset({"cpu"})
    monkeypatch.setattr(gsplat_backend, "_gsplat_rasterization", lambda: ours)
    gsplat = gsplat_backend.GsplatRasterizer
    monkeypatch.setattr(gsplat, "traits", replace(gsplat.traits, devices=on_cpu))
    monkeypatch.setattr(rasterizers, "names", lambda: ["gsplat"])
    doctor.main([])
    assert f"{'gsplat':32}works: differs from the reference by" in capsys.readouterr().out


def test_a_backend_that_draws_something_else_is_an_error(capsys, monkeypatch):
    calls = iter(
        [rasterizers.load("torch"), rasterizers.load("torch", alpha_max=0.3)]
    )  # the reference, and what is tested
    monkeypatch.setattr(rasterizers, "names", lambda: ["torch"])
    monkeypatch.setattr(rasterizers, "load", lambda name: next(calls))
    with pytest.raises(SettingError, match="torch draws something else than the reference"):
        doctor.main([])
    assert "WRONG" in capsys.readouterr().out
