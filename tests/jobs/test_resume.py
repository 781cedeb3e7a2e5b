"""Resuming a job: what must agree with the run before, and what may differ."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from PIL import Image, ImageOps

import clear_strategies
from clear_strategies.compose import tree
from clear_strategies.errors import DataError, SettingError
from clear_strategies.jobs import job, resume
from clear_strategies.jobs import scene as scenes
from clear_strategies.signals import Interrupted
from clear_strategies.training.loop import iterate
from clear_strategies.training.state import fingerprints
from tests.helpers import captures, forked, toy
from tests.helpers.command_line import ALONE, RANDOM_POINTS, TINY, run, times_of_files
from tests.helpers.configs import composed
from tests.helpers.short_run import SCENE, start


def compared(*overrides: str):
    return resume.comparable(tree(composed(*overrides)))


def test_resuming_on_another_device_is_logged(caplog):
    state = start(())
    iterate(state, toy.RASTERIZER)
    saved = state.checkpoint({})
    resume.restore(start(()), SCENE, saved, Path("there"))
    assert "bit for bit" not in caplog.text
    resume.restore(start(()), SCENE, replace(saved, device="cuda"), Path("there"))
    assert "this run trained on cuda until now and continues on cpu" in caplog.text


def test_device_threads_and_memory_may_differ_and_of_files_that_moved_the_content_is_compared(tmp_path):
    assert compared("fit.device=cpu", "fit.threads=1", "rasterizer.memory=512") == compared()
    assert compared()["fit.seed"] == 0  # a default of the class, which no file gives
    with pytest.raises(DataError, match=r"density\.every: 50 then, 100 now"):
        resume.require_same(Path("there"), compared("density.every=50"), compared())
    for name, content in (("a", b"1"), ("b", b"1"), ("c", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, c = (compared("data.cloud.init=ply", f"data.cloud.path={tmp_path / name}") for name in "abc")
    resume.require_same(Path("there"), a, b)
    with pytest.raises(DataError, match=r"data\.cloud\.path digest: "):
        resume.require_same(Path("there"), a, c)


def test_of_a_strategy_that_one_configuration_lacks_no_field_is_listed():
    """Five differences are listed: they would all be of the first such strategy."""
    words = ("+strategy=gco", "fit.seed=1"), ("+strategy=[gco,p2g,svs]",)
    with pytest.raises(DataError) as refused:
        resume.require_same(Path("there"), *(compared(*overrides) for overrides in words))
    listed = "fit.seed: 1 then, 0 now; strategies.p2g._target_: None then, 'clear_strategies.P2G' now; strategies.svs._target_: "
    assert listed in str(refused.value)


@pytest.mark.parametrize("left", ["checkpoint", "finished"])
def test_a_run_goes_on_with_sr_images_at_another_place_and_not_with_others_be_it_that_they_shrink_to_the_same_photos(
    left: str, tmp_path: Path, caplog
) -> None:
    caplog.set_level("INFO")
    photos, sr, folder = captures.demo_on_disk(tmp_path / "photos"), tmp_path / "sr", tmp_path / "run"
    words = ["prior=images", "+strategy=back_projected", "data.views.photos_are=hr"]
    sr.mkdir()
    for photo in photos.rglob("*.png"):
        shutil.copy(photo, sr)
    train_on(photos, folder, *words, f"prior.path={sr}")
    if left == "checkpoint":
        (folder / "metrics.json").unlink()
    (sr / "of_no_training_view.png").write_bytes(b"no picture")
    moved = sr.rename(tmp_path / "moved")
    train_on(photos, folder, *words, f"prior.path={moved}", "fit.resume=auto")
    assert ("resumed from" if left == "checkpoint" else "nothing is trained") in caplog.text
    if left == "checkpoint":
        (folder / "metrics.json").unlink()
    moved.rename(sr)
    with Image.open(sr / "0.png") as image:
        image.resize((image.width // 4, image.height // 4)).resize(image.size).save(sr / "0.png")
    with pytest.raises(DataError, match=r"1 of 4 have another content, mask or SR image .*, such as 0\.png"):
        train_on(photos, folder, *words, f"prior.path={sr}", "fit.resume=auto")


def test_ctrl_c_after_training_names_the_checkpoint_that_was_saved(tmp_path: Path, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(job.results, "write_results", stopped)
    with pytest.raises(Interrupted) as told:
        job.run(composed(*TINY, "+strategy=gco", "prior=bicubic", "fit.threads=1", "fit.iterations=3"), tmp_path)
    saved = tmp_path / "checkpoints" / "step_0000004.safetensors"
    assert saved.is_file()
    assert (
        str(told.value)
        == f"stopped by SIGINT before the run was finished. Go on by the same command with fit.resume={saved}."
    )


def test_a_setting_of_density_has_no_effect_beside_a_strategy_that_densifies(tmp_path: Path, caplog):
    for strategy in ("mcmc", "gco"):
        settings = "prior=bicubic fit.threads=1 fit.iterations=3 density.every=50"
        chosen = [*TINY, f"+strategy={strategy}", *settings.split()]
        with forked.not_drawn():
            job.run(composed(*chosen, "fit.scale_schedule=false"), tmp_path / strategy, chosen)
    assert caplog.text.count("density.every=50 has no effect: MCMC densifies in place of it.") == 1


MOVED = [*ALONE, *RANDOM_POINTS, "prior=bicubic", "fit.max_degree=1", "fit.iterations=4"]


def train_on(photos: Path, folder: Path, *more: str) -> None:
    words = ["data=nerfstudio", f"data.path={photos}", *MOVED, *more]
    with forked.not_drawn():
        job.run(composed(*words), folder, words)


@pytest.mark.parametrize("there", ["checkpoint", "finished"])
def test_a_run_goes_on_where_its_data_moved_and_not_on_other_data(there: str, tmp_path: Path, caplog) -> None:
    caplog.set_level("INFO")
    here, folder = captures.demo_on_disk(tmp_path / "here"), tmp_path / "run"
    train_on(here, folder)
    if there == "checkpoint":
        (folder / "metrics.json").unlink()
    other = shutil.copytree(here, tmp_path / "other")
    captures.edit(
        other / "transforms.json", lambda value: value["frames"][0]["transform_matrix"][0].__setitem__(3, 9.0)
    )
    with pytest.raises(
        DataError, match=r"1 of 4 photos have another name, size or pose than in this run, such as 0\.png: give"
    ):
        train_on(other, folder, "fit.resume=auto")
    train_on(here.rename(tmp_path / "moved"), folder, "fit.resume=auto")
    assert ("resumed from" if there == "checkpoint" else "nothing is trained") in caplog.text
    assert (folder / "metrics.json").is_file()


@pytest.mark.parametrize("changed", ["a training photo", "a test photo", "a mask"])
def test_a_run_does_not_go_on_with_a_photo_or_a_mask_whose_content_has_changed(changed: str, tmp_path: Path) -> None:
    photos, folder = captures.demo_on_disk(tmp_path / "photos"), tmp_path / "run"
    test = ["data.views.test_every=4"] * (changed == "a test photo")
    masks = photos / "masks"
    if changed == "a mask":
        masks.mkdir()
        for photo in sorted(photos.rglob("*.png")):
            Image.new("L", Image.open(photo).size, 255).save(masks / photo.name)
    train_on(photos, folder, *test)
    if changed == "a mask":
        with Image.open(masks / "0.png") as mask:
            mask.paste(0, (0, 0, 8, 8))
            mask.save(masks / "0.png")
    else:
        (photo,) = (file for file in photos.rglob("0.png") if file.parent != masks)
        with Image.open(photo) as image:
            ImageOps.mirror(image).save(photo)
    with pytest.raises(
        DataError,
        match=r"run: photos: 1 of 4 have another content, mask or SR image than in this run, such as 0\.png: ",
    ):
        train_on(photos, tmp_path / "other", f"fit.resume={folder}", *test)


def test_rounding_is_no_change_of_a_photo():
    def brighter(by: float):
        first, *others = SCENE.train
        changed = replace(SCENE, train=(replace(first, lr=replace(first.lr, image=first.lr.image + by)), *others))
        (state := start(())).photos = fingerprints(changed)
        return state

    saved = start(()).checkpoint({})
    resume.restore(brighter(1e-4), SCENE, saved, Path("there"))
    with pytest.raises(DataError, match=f"there: photos: 1 of 4 have another .* such as {SCENE.train[0].name}: "):
        resume.restore(brighter(1e-2), SCENE, saved, Path("there"))
    fewer = {name: x for name, x in saved.tensors.items() if name != f"photos/{SCENE.test[0].name}"}
    with pytest.raises(DataError, match=f"there: photos: 1 of 4 .* such as {SCENE.test[0].name}: "):
        resume.restore(start(()), SCENE, replace(saved, tensors=fewer), Path("there"))


def test_that_few_photos_have_a_pose_is_said_first_and_last(tmp_path: Path, monkeypatch, caplog) -> None:
    caplog.set_level("INFO")

    def few_placed(*words, load=scenes.load):
        return replace(scene := load(*words), notes={**scene.notes, scenes.FEW_PLACED: "3 of 9 photos"})

    monkeypatch.setattr(scenes, "load", few_placed)
    train_on(captures.demo_on_disk(tmp_path / "here"), tmp_path / "run")
    said = [record.getMessage() for record in caplog.records]
    warned = [i for i, message in enumerate(said) if message == "3 of 9 photos."]
    done = next(i for i, message in enumerate(said) if message.startswith("done in"))
    assert len(warned) == 2
    assert warned[0] < done < warned[1] == len(said) - 1


@pytest.mark.parametrize(
    "refused",
    ["fit.iterations=-3", "fit.seed=9 fit.resume=auto", "data.path=nowhere", "+strategy=[gco,gco]", "fit.video=0"],
)
def test_a_command_that_is_refused_writes_nothing_into_the_folder_of_a_run(refused: str, finished_run: Path) -> None:
    before = times_of_files(finished_run)
    words = ["data=nerfstudio", f"data.path={finished_run.parent / 'photos'}", *MOVED]
    assert "iterations=4" in (finished_run / ".hydra/overrides.yaml").read_text()
    ended = run(*words, "hydra.run.dir=run", *refused.split(), cwd=finished_run.parent)
    assert ended.returncode == 2, ended.stdout + ended.stderr
    assert times_of_files(finished_run) == before


@pytest.mark.parametrize("left", ["results", "checkpoints"])
def test_a_second_run_replaces_the_first_only_where_it_is_asked_to(
    left: str, finished_run: Path, tmp_path: Path
) -> None:
    folder, photos = shutil.copytree(finished_run, tmp_path / "run"), finished_run.parent / "photos"
    if left == "checkpoints":  # it was stopped
        (folder / "metrics.json").unlink()
    remedy = "take another folder, go on with fit.resume=auto, or replace it with fit.overwrite=true"
    with pytest.raises(
        DataError, match=rf"run: folder: holds the {left} of a run, which this one would remove: {remedy}"
    ):
        train_on(photos, folder)
    with pytest.raises(DataError, match=f"holds the {left}"):
        clear_strategies.train(photos, *MOVED, folder=folder)
    train_on(photos, folder, "fit.overwrite=true", "fit.seed=1")
    assert json.loads((folder / "metrics.json").read_text())["seed"] == 1


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    photos = captures.demo_on_disk(folder / "photos")
    ended = run("data=nerfstudio", f"data.path={photos}", *MOVED, "hydra.run.dir=run", cwd=folder)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    log = (folder / "run/run.log").read_text()
    assert "poses" in log
    assert "done in" in log
    return folder / "run"


def test_a_command_that_is_refused_leaves_no_empty_folder_and_default_folders_differ(tmp_path: Path) -> None:
    assert run("data=demo", "fit.iterations=-3", cwd=tmp_path).returncode == 2
    assert not list((tmp_path / "outputs/demo").iterdir())
    folders = OmegaConf.to_container(composed(hydra=True), resolve=False)["hydra"]
    assert all("%f" in folders[kind]["dir"] for kind in ("run", "sweep"))


def test_a_run_from_python_that_is_refused_leaves_no_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingError, match=r"fit\.iterations: must be"):
        clear_strategies.train(None, "fit.iterations=0")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("fit.resume=gone", "gone: checkpoint: no checkpoint is here: "),
        ("fit.resume=run density.every=50", "config: this is not the configuration that wrote it: density.every: 100 then, 50"),
        ("data.path=gone/fern", "gone: data.path: is not there: correct the path"),
        ("prior=images prior.path=gone", "gone: prior.path: is not there: correct the path"),
        ("data.cloud.init=ply data.cloud.path=gone.ply", "gone.ply: data.cloud.path: is not there: correct the path"),
    ],
)  # fmt: skip
def test_what_is_not_there_and_another_configuration_are_told_before_data_are_read(
    wrong: str, told: str, finished_run: Path, monkeypatch
) -> None:
    """To find poses and to make SR images takes minutes."""
    monkeypatch.chdir(finished_run.parent)
    monkeypatch.setattr(scenes, "load", lambda *_: pytest.fail("data are read"))
    words = ["data=nerfstudio", f"data.path={finished_run.parent / 'photos'}", *MOVED, *wrong.split()]
    with pytest.raises(DataError, match=re.escape(told)):
        job.run(composed(*words), Path("other"), words)
