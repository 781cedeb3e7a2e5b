"""The scene of a job: which photos, what is checked of them, what the log says of the prior, and other units."""

import functools
import hashlib
import json
from dataclasses import replace
from pathlib import Path
from statistics import median

import pytest
import torch

from clear_strategies.commands import train
from clear_strategies.compose import tree
from clear_strategies.core.points import spread
from clear_strategies.data import photo_files
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.priors import Bicubic, Corrupted, DemoPrior, Images, Ncnn, ncnn
from clear_strategies.data.readers import demo
from clear_strategies.data.scene import Scene
from clear_strategies.data.view_settings import ViewSettings, split
from clear_strategies.errors import DataError, SettingError
from clear_strategies.jobs import job
from clear_strategies.jobs.saved import open_splat
from clear_strategies.jobs.scene import AutoPrior, DataSettings, load, read
from clear_strategies.jobs.settings import JobSettings, settings_of
from tests.helpers import captures, command_line, fake_ncnn
from tests.helpers.command_line import ALONE
from tests.helpers.configs import composed


def test_a_photo_that_no_view_uses_may_be_too_small(caplog):
    capture = demo.read(width=64, height=48, views=5, train=2)
    unused = max(i for i, frame in enumerate(capture.frames) if frame.split == "test")
    tiny = replace(capture.frames[unused], camera=capture.frames[unused].camera.scaled(1 / 16))
    frames = tuple(tiny if i == unused else frame for i, frame in enumerate(capture.frames))
    views = ViewSettings(train=2, test_limit=1, photos_are="hr")
    with caplog.at_level("DEBUG"):
        scene = load(DataSettings(reader=lambda: replace(capture, frames=frames), views=views), AutoPrior(), 0)
    assert tiny.name not in {view.name for view in (*scene.train, *scene.test)}
    assert "prior: auto chose demo" in caplog.text
    assert AutoPrior().of(replace(capture, name="mine"), views).label.startswith("demo (synthetic")


@pytest.mark.parametrize("whose", ["capture", "frame", "unplaced"])
def test_a_name_that_is_no_text_is_refused_before_training(whose: str):
    capture, name = demo.read(width=64, height=48, views=5, train=2), "photo_\udce9"  # as Python reads a Latin-1 é
    named = {
        "capture": {"name": name},
        "frame": {"frames": (replace(capture.frames[0], name=name), *capture.frames[1:])},
        "unplaced": {"unplaced": {name: "blurred"}},
    }
    with pytest.raises(DataError, match=r"^photo_\\udce9: name: must be UTF-8"):
        load(DataSettings(reader=lambda: replace(capture, **named[whose])), AutoPrior(), 0)


def of_photos(factor: int = 4) -> Scene:
    """The demo's photos as a data set that is not the demo."""
    capture = replace(demo.read(width=96, height=48, views=4, train=2), name="mine", own_prior=None)
    views = ViewSettings(train=2, sr_scale=factor, photos_are="hr")
    data = DataSettings(reader=lambda: capture, views=views, cloud=CloudSettings(init="random", random_points=20))
    return load(data, AutoPrior(), 0)


def test_auto_takes_waifu2x_where_it_is_installed_and_says_nothing_else_of_it(tmp_path, monkeypatch, caplog):
    fake_ncnn.install(tmp_path / "site", monkeypatch)
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path / "cache"))
    with caplog.at_level("DEBUG"):
        scene = of_photos()
    assert caplog.text.count("prior: auto chose waifu2x (photo model).") == 1
    assert "pip install" not in caplog.text
    assert {view.sr_source for view in (*scene.train, *scene.test)} == {"waifu2x (photo model)"}
    assert scene.notes["SR network"].startswith("WAIFU2X_PHOTO_UP2X.param ")
    assert not scene.synthetic_prior
    caplog.clear()
    with caplog.at_level("DEBUG"):
        again = of_photos()
    assert caplog.text.count("SR image from the cache (waifu2x (photo model))") == 4
    assert [(v.hr.image == w.hr.image).all() for v, w in zip(scene.train, again.train, strict=True)] == [True, True]


@pytest.mark.parametrize("sizes", ["crop", "round"])
@pytest.mark.parametrize("shrink", [1, 2])
def test_the_demo_prior_without_errors_gives_the_hr_photos_whatever_their_size(sizes, shrink):
    photos = demo.read(width=58, height=45, views=3, train=2)
    views = ViewSettings(photos_are="hr", sizes=sizes, shrink=shrink)
    data = DataSettings(reader=lambda: photos, views=views, cloud=CloudSettings(init="random", random_points=20))
    scene = load(data, functools.partial(DemoPrior, share=0.0), 0)
    for view in scene.train:
        assert float((view.hr.image - view.truth).abs().max()) <= 0.51 / 255  # a prior's image has 8 bits


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio", "blender"])
def test_no_photos_of_a_folder_called_demo_are_taken_for_their_own_sr_images(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(ncnn, "find_spec", lambda name: None)
    root, reader = captures.GOOD[kind](tmp_path / "demo"), captures.READERS[kind]
    assert reader(root=str(root)).name == "demo"
    views = ViewSettings(photos_are="hr", sr_scale=2, train=2, test_limit=1)
    cloud = CloudSettings(init="random", random_points=20)
    scene = load(DataSettings(reader=lambda: reader(root=str(root)), views=views, cloud=cloud), AutoPrior(), 0)
    assert {view.sr_source for view in scene.train} == {Bicubic().label}
    assert not scene.synthetic_prior


def test_auto_names_the_extra_in_one_line_and_says_why_a_factor_is_left_to_bicubic(monkeypatch, caplog, tmp_path):
    monkeypatch.setattr(ncnn, "find_spec", lambda name: None)
    with caplog.at_level("DEBUG"):
        scene = of_photos()
    lines = [line for line in caplog.messages if "prior" in line or "pip install" in line]
    assert lines == [
        "prior: auto chose bicubic (no detail beyond LR). For a super-resolution network: "
        "pip install 'clear-strategies[sr]'."
    ]
    assert "SR network" not in scene.notes
    fake_ncnn.install(tmp_path, monkeypatch)
    of_photos(factor=3)
    assert "auto chose bicubic (no detail beyond LR). waifu2x enlarges by 2 or 4, not by 3; for SR" in caplog.text


def test_a_factor_that_the_network_has_not_and_a_prior_without_a_label_are_refused(tmp_path, monkeypatch):
    fake_ncnn.install(tmp_path, monkeypatch)
    for prior in ("realesrgan", "waifu2x"):
        values = tree(composed(f"prior={prior}", "data.views.sr_scale=3"))
        with pytest.raises(SettingError, match=rf"^data\.views\.sr_scale: must be (2 or )?4 with {prior}, got 3: "):
            settings_of(values)
    settings = settings_of(tree(composed("data.views.sr_scale=2")))
    replace(settings, prior=Corrupted(Ncnn()))
    with pytest.raises(SettingError, match="must be 4 with realesrgan, got 2"):
        replace(settings, prior=Corrupted(Ncnn("realesrgan")))
    with pytest.raises(SettingError, match="prior: Unlabelled is no Prior: it needs the property label"):
        settings_of(tree(composed(f"prior._target_={__name__}.Unlabelled")))


class Unlabelled:
    def __call__(self, name, lr, factor):
        raise NotImplementedError


# ---- what a capture is by default: all of its photos. What it is under a protocol: the same bits for ever
def settings(*overrides: str) -> JobSettings:
    return settings_of(tree(composed(*overrides, "prior=bicubic", "data.cloud.init=random")))


def used_by_default(folder: Path) -> tuple[int, int, int]:
    """How many photos `clear-strategies train FOLDER` finds, trains on and tests on."""
    data = settings(*train.overrides([str(folder)])).data
    capture = data.reader()
    pool, test = split(capture, data.views)
    return len(capture.frames), len(pool), len(test)


@pytest.mark.parametrize(
    "write", [captures.colmap_bin, captures.colmap_txt, captures.llff, captures.nerfstudio, captures.blender]
)
def test_every_readers_default_uses_all_photos_and_a_split_of_the_data_sets_own_stays(write, tmp_path: Path) -> None:
    assert used_by_default(write(tmp_path)) == ((3, 2, 1) if write is captures.blender else (3, 3, 0))


@pytest.mark.parametrize(
    ("name", "found"),
    [("kitchen360", (24, 24, 0)), ("real_room", (35, 35, 0)), ("fern", (20, 20, 0)), ("lego", (50, 25, 25))],
)
def test_the_real_scenes_are_used_whole(name: str, found: tuple[int, int, int], shared_data: Path) -> None:
    assert used_by_default(shared_data / name) == found


# As commit d8541c9 read them, the last before the readers took all photos by default. LLFF's and COLMAP's scene are the same.
PROTOCOLS = {
    "llff_x4": (captures.llff, ["data.views.train=2"], "46168a5e571aae82"),
    "mip360_x4": (captures.colmap_bin, ["data.views.train=2"], "46168a5e571aae82"),
    "blender_x4": (captures.blender, ["data.views.train_names=[b,a]"], "713820e4480d9b58"),
}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_under_a_protocol_photos_and_cameras_keep_their_bits(protocol, tmp_path, monkeypatch):
    monkeypatch.setattr("clear_strategies.data.prepare.SMALLEST", 1)  # px that scores need, more than these photos have
    write, changed, expected = PROTOCOLS[protocol]
    scene = write(tmp_path / "scene").name
    job = settings(f"+protocol={protocol}", f"data.root={tmp_path}", f"data.scene={scene}", *changed)
    assert fingerprint(load(job.data, job.prior, 0)) == expected


def fingerprint(scene: Scene) -> str:
    """Of the LR and HR photos in 8 bits, and of the cameras; poses to six digits, since libraries differ in the last."""
    digest = hashlib.sha256()
    for part in (scene.train, scene.test):
        for view in part:
            for image in (view.lr.image, view.truth):
                digest.update((image * 255).round().to(torch.uint8).numpy().tobytes())
            for camera in (view.lr.camera, view.hr.camera):
                size = (
                    camera.width, camera.height, *(round(x, 6) for x in (camera.fx, camera.fy, camera.cx, camera.cy)),
                )  # fmt: skip
                pose = [[round(x, 6) + 0.0 for x in row] for row in camera.world_to_camera.tolist()]
                digest.update(json.dumps([view.name, size, pose]).encode())
    return digest.hexdigest()[:16]


# ---- a scene in other units trains to the same picture, and what was saved of it can be looked at
SETTINGS = [
    *ALONE, "prior=bicubic", "data.views.photos_are=hr", "data.views.test_every=3", "+strategy=best", "fit.iterations=30",
    "skips=none", "fit.threads=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory):
    @functools.cache
    def train(scale: float) -> tuple[float, Path, str]:
        """PSNR of the test views, dB, the run's folder, and what is said, of a room `scale` times as large."""
        here = tmp_path_factory.mktemp("units")
        root = captures.demo_on_disk(here / "room", scale, views=6, size=(96, 72))
        done = command_line.run("data=nerfstudio", f"data.path={root}", *SETTINGS, "hydra.run.dir=run", cwd=here)
        scores = json.loads((here / "run/metrics.json").read_text())["test"]["mean"]["ours"]
        return scores["psnr"], here / "run", done.stdout

    return train


@pytest.mark.parametrize("scale", [1e-5, 1e5])
def test_a_scene_in_other_units_gives_equal_results(scale: float, trained) -> None:
    score, folder, said = trained(scale)
    # By rounding alone, the scores of 21 scales from 1e-5 to 1e5 deviate by 0.13 dB; a length in wrong units costs several.
    assert score == pytest.approx(median(trained(near)[0] for near in (0.7, 1.0, 1.3)), abs=0.4)
    assert "warning: " not in said
    for saved in (folder, folder / "point_cloud.ply"):
        splat = open_splat(saved)
        assert spread(splat.painter.field.means.data) == pytest.approx(3 * scale, rel=0.5)
        image = splat.painter.color(splat.poses()[0])
        assert float(image.std()) > 0.05


def test_lr_images_are_saved_at_the_size_that_images_of_another_program_need_without_stereo(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr("clear_strategies.data.prepare.initial_points", None)
    words = [
        "data=demo", "data.reader.width=128", "data.reader.height=96", "data.views.photos_are=lr",
        f"data.save_lr={tmp_path / 'lr'}", "data.views.max_hr_megapixels=0.1",
    ]  # fmt: skip
    with caplog.at_level("INFO"):
        assert job.run(composed(*words), tmp_path / "run", words) is None
    assert "iterations" not in caplog.text  # nothing is trained
    reader = functools.partial(demo.read, width=128, height=96)
    used = read(DataSettings(reader=reader, views=ViewSettings(max_hr_megapixels=0.1)), Images(str(tmp_path)))[0]
    assert {file.stem for file in (tmp_path / "lr").iterdir()} == {frame.name for frame in used.frames}
    camera = used.frames[0].camera
    assert photo_files.read_header(tmp_path / f"lr/{used.frames[0].name}.png").size(None) == (
        camera.width,
        camera.height,
    )
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    monkeypatch.setattr("clear_strategies.jobs.scene._ENOUGH", 2.0)
    job.run(composed(*words), tmp_path / "again", words)
    assert "12 of 12 photos (100%) have a pose" in caplog.text
