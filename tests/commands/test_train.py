"""`clear-strategies train PHOTOS`: which reader, which settings, and what it says to a wrong argument."""

from pathlib import Path

import pytest

from clear_strategies import commands, hydra_app
from clear_strategies.commands import train
from clear_strategies.compose import composed, tree
from clear_strategies.errors import SettingError
from clear_strategies.files import write_text
from clear_strategies.notebook import Run
from tests.helpers.finished_run import make_run


def test_of_several_formats_the_one_that_may_hold_the_others_is_read_and_named_strategies_replace_best(tmp_path):
    for file, kind in (("cameras.bin", "colmap"), ("transforms.json", "nerfstudio")):
        (tmp_path / file).touch()
        assert train.detect(tmp_path) == kind
    assert train.detect(tmp_path / "transforms.json") == "nerfstudio"
    assert "+strategy=best" not in train.overrides([str(tmp_path), "+strategy=gco"])
    assert "+strategy=best" in train.overrides([str(tmp_path)])
    assert not any(o.startswith("fit.iterations") for o in train.overrides([str(tmp_path), "+protocol=llff_x4"]))


PLAIN = ("photos", "a/b-c.d", "my photos", "-photos")
QUOTED = ("1e5", "null", " photos", "a=b,c", "it's [here] (1)", "ends\\", "q\\s'", "${oc.env:HOME}", "\\${x}", "${")


@pytest.mark.parametrize("name", [*PLAIN, *QUOTED])
def test_a_folder_of_any_name_becomes_data_path_quoted_only_where_hydra_would_read_another(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir(parents=True)
    overrides = train.overrides([name, "fit.iterations=7"])
    assert (f"data.path={name}" in overrides) == (name in PLAIN)
    config = composed(overrides, "config")
    assert tree(config)["data"]["path"] == name
    assert config.fit.iterations == 7
    assert set(config.strategies) == {
        "gco",
        "p2g",
        "svs",
        "pseudo_views",
        "fading_opacity",
        "mcmc",
        "random_background",
    }


@pytest.mark.parametrize("flag", ["--config-dir", "-cd"])
def test_a_folder_of_options_is_no_second_folder_of_photos(tmp_path, monkeypatch, flag):
    monkeypatch.chdir(tmp_path)
    for name in ("photos", "mine"):
        (tmp_path / name).mkdir()
    assert train.overrides(["photos", flag, "mine", "fit.seed=1"])[-3:] == [flag, "mine", "fit.seed=1"]
    with pytest.raises(SettingError, match="mine is a second folder"):
        train.overrides(["photos", "mine"])


@pytest.mark.parametrize(
    ("module", "cause"),
    [
        (None, r"\(No module named 'absent_reader'\)\. Correct its name, or PYTHONPATH\."),
        ("1 / 0", r": .*absent_reader\.py:1: ZeroDivisionError: division by zero\. Correct that file\."),
    ],
)
def test_a_reader_of_a_folder_of_options_that_cannot_be_imported_is_named(tmp_path, monkeypatch, module, cause):
    monkeypatch.chdir(tmp_path)
    write_text(tmp_path / "mine" / "data" / "odd.yaml", "reader: {_target_: absent_reader.read}")
    write_text(tmp_path / "mine" / "data" / "none.yaml", "reader: null")
    if module:
        write_text(tmp_path / "modules" / "absent_reader.py", module)
        monkeypatch.syspath_prepend(tmp_path / "modules")
    with pytest.raises(SettingError, match=rf"^data=odd: reader: absent_reader\.read cannot be imported ?{cause}$"):
        train.overrides([".", "--config-dir", "mine"])


def test_a_file_of_options_that_is_malformed_is_named_with_its_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "mine" / "data" / "odd.yaml"
    write_text(file, "reader:\n  a: [\n")
    for command in (lambda flag: train.overrides([".", flag]), lambda flag: hydra_app.main([flag, "data=odd"])):
        with pytest.raises(SettingError, match=r"is no valid YAML: .*odd\.yaml\", line 3.* Correct that line\."):
            command("--config-dir=mine")
    write_text(file, "- a\n")
    with pytest.raises(SettingError, match=r"odd\.yaml: .* has lines as `name: value`, got \['a'\]\. Correct it\."):
        train.overrides([".", "--config-dir=mine"])


@pytest.mark.parametrize("hidden", ["config.yaml", "strategy/gco.yaml"])  # the first: that of RUN/.hydra
def test_a_folder_of_options_whose_file_hydra_would_not_read_is_refused(tmp_path, monkeypatch, hidden):
    monkeypatch.setattr(hydra_app, "_run_hydra", lambda *_: None)
    (tmp_path / hidden).parent.mkdir(exist_ok=True)
    (tmp_path / hidden).touch()
    with pytest.raises(SettingError, match=rf"--config-dir: .*{hidden} is not read, .* --config-path\."):
        hydra_app.main([f"--config-dir={tmp_path}", "--config-name=config", "+strategy=gco"])


def test_a_path_with_spaces_that_is_not_quoted_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "Meine Fotos").mkdir()
    for _ in range(2):
        with pytest.raises(
            SettingError, match=r"train: Meine Fotos has spaces.*: clear-strategies train 'Meine Fotos'\."
        ):
            train.overrides(["Meine", "Fotos", "fit.seed=1"])
        (tmp_path / "Meine").mkdir(exist_ok=True)  # a folder of the first word is there, too


def test_a_tilde_that_no_shell_expanded_is_the_users_folder(tmp_path, monkeypatch):
    """In the argument of `train`, in Hydra's own folders, and in the arguments of the other commands."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "photos").mkdir()
    assert f"data.path={tmp_path}/photos" in train.overrides(["~/photos"])
    for key in ("hydra.run.dir", "+hydra.sweep.dir"):
        assert hydra_app.readable(f"{key}=~/out/${{now:%H}}") == f"{key}={tmp_path}/out/${{now:%H}}"
    given = []
    monkeypatch.setattr(
        hydra_app, "_run_hydra", lambda options, *_: given.extend([options.config_dir, options.config_path])
    )
    hydra_app.main(["--config-dir=~/more", "--config-path=~/own"])
    monkeypatch.chdir(tmp_path)
    hydra_app.main(["--config-path=run/.hydra"])
    assert given == [f"{tmp_path}/more", f"{tmp_path}/own", None, f"{tmp_path}/run/.hydra"]
    assert commands.parser_of("view", "").parse_args(["~/run"]).run == tmp_path / "run"
    make_run(tmp_path / "done")
    assert Run(Path("~/done")).folder == tmp_path / "done"


def test_an_address_is_told_to_be_downloaded_and_a_run_to_be_viewed(tmp_path):
    with pytest.raises(
        SettingError, match=r"run is the folder of a run, .*strategies view .*run shows it; .* fit\.resume="
    ):
        train.overrides([str(make_run(tmp_path / "run"))])
    with pytest.raises(SettingError, match=r"https://a\.b/c\.zip is an address\. Download what is there"):
        train.overrides(["https://a.b/c.zip"])


@pytest.mark.parametrize("name", ["it's", 'a "b" c', "a, (b)", "a=b", "[x", "a{b}"])
def test_data_path_of_any_letters_needs_no_quotes_of_hydras(tmp_path, name):
    (tmp_path / name).mkdir()
    word = hydra_app.readable(f"data.path={tmp_path / name}")
    assert composed(["data=colmap", word], "config").data.path == str(tmp_path / name)
    for as_it_is in ("fit.seed=1,2", "+strategy=[gco,svs]", "~prior"):
        assert hydra_app.readable(as_it_is) == as_it_is
