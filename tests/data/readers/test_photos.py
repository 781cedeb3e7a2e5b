"""Photos without poses: structure from motion finds the true cameras, up to a similarity, and caches them."""

import errno
import itertools
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image, ImageFilter
from scipy.spatial.transform import Rotation

from clear_strategies import files
from clear_strategies.core.images import to_bytes
from clear_strategies.data.photo_files import Header, read_header
from clear_strategies.data.readers import colmap, demo, features, photos, sfm
from clear_strategies.data.readers.features import SfmSettings
from clear_strategies.errors import DataError

pycolmap = pytest.importorskip("pycolmap")


@pytest.mark.slow
def test_poses_are_those_of_the_ground_truth(shared_data, tmp_path, monkeypatch, caplog):
    """Five views of fountain-P11 at 384x256: rotations within 1 degree, centres within 2 % of their largest offset. They count as
    large here; too few features are found at their own size, and they are enlarged after all.
    """
    monkeypatch.setattr(features, "_LARGE", 0)
    folder = tmp_path / "photos"
    folder.mkdir()
    truth = colmap.read(shared_data / "strecha_fountain").frames[2:7]
    for frame in truth:
        with Image.open(shared_data / "strecha_fountain/images" / frame.name) as image:
            image.resize((384, 256), Image.Resampling.LANCZOS).save(folder / frame.name, quality=97)
    Image.new("RGB", (384, 256), (90, 90, 90)).save(folder / "z_flat.png")
    with caplog.at_level(logging.INFO):
        capture = photos.read(folder, tmp_path / "cache", threads=1)
    assert "they are found again, in photos enlarged twice" in caplog.text
    assert [frame.name for frame in capture.frames] == [frame.name for frame in truth]
    assert "estimated by pycolmap from all 6 photos, 5 could be placed" in capture.notes["poses"]
    assert capture.unplaced == {"z_flat.png": "0 features: blurred, dark, or without texture"}
    assert len(capture.points.means) > 100

    (R, p), (S, q) = (
        (Rotation.from_matrix([f.camera.world_to_camera[:3, :3].numpy() for f in frames]),
         np.stack([f.camera.center.numpy() for f in frames]))
        for frames in (capture.frames, truth)
    )  # fmt: skip
    relative = (R[1:] * R[0].inv()) * (S[1:] * S[0].inv()).inv()  # to the first camera
    assert np.degrees(relative.magnitude()).max() < 1
    p, q = p - p.mean(0), q - q.mean(0)
    turned = Rotation.align_vectors(q, p)[0].apply(p)
    aligned = turned * (turned * q).sum() / (p**2).sum()
    assert np.linalg.norm(aligned - q, axis=1).max() < 0.02 * np.linalg.norm(q, axis=1).max()

    # A second reading takes the cached poses: without pycolmap it cannot estimate. Nothing is written among the photos.
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # makes its import fail
    again = photos.read(folder, tmp_path / "cache", threads=1)
    for one, other in zip(capture.frames, again.frames, strict=True):
        assert torch.equal(one.camera.world_to_camera, other.camera.world_to_camera)
    assert again.unplaced == capture.unplaced
    assert sorted(p.name for p in folder.iterdir()) == [*(frame.name for frame in truth), "z_flat.png"]
    assert len(list((tmp_path / "cache").iterdir())) == 1


@pytest.fixture(scope="module")
def room() -> list[Image.Image]:
    """Four photos of the demo's room, by a lens of 31 mm on 35 mm film, that overlap."""
    return [Image.fromarray(to_bytes(frame.load().image)) for frame in demo.read(width=200, height=150).frames[:4]]


def save_photos(folder: Path, pictures: Sequence[Image.Image], *focals: int) -> Path:
    """Files of photos, with these focal lengths on 35 mm film in EXIF: of each, or of all."""
    folder.mkdir()
    for i, (picture, focal) in enumerate(zip(pictures, focals * (len(pictures) // len(focals)), strict=True)):
        exif = Image.Exif()
        # Pillow 10 saves no block that get_ifd has made.
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: focal}
        picture.save(folder / f"{i}.jpg", quality=95, exif=exif)
    return folder


@pytest.mark.parametrize(
    ("focals", "told"),
    [
        ((600,), "(600 mm on 35 mm film) is not used: 0 of 4 photos are placed with it, 4 without"),
        ((31, 31, 31, 600), ""),
    ],
)
def test_photos_are_placed_whatever_focal_length_exif_claims(room, tmp_path, caplog, focals, told: str) -> None:
    capture = photos.read(save_photos(tmp_path / "photos", room, *focals), tmp_path / "cache", threads=1)
    assert len(capture.frames) == 4
    assert [frame.camera.fx for frame in capture.frames] == pytest.approx([180] * 4, rel=0.1)
    assert (told in caplog.text) if told else not caplog.text


def test_photos_have_one_camera_whose_exif_blocks_say_the_same_of_the_lens(room, tmp_path: Path) -> None:
    """The last photo is zoomed by the camera's software, with the focal length of the others in EXIF."""
    zoomed = room[3].resize((200, 150), Image.Resampling.BICUBIC, box=(20, 15, 180, 135))
    folder = save_photos(tmp_path / "photos", [*room[:3], zoomed], 31)
    with Image.open(folder / "3.jpg") as image:
        exif = image.getexif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DigitalZoomRatio] = 1.25
        zoomed.save(folder / "3.jpg", quality=95, exif=exif)
    capture = photos.read(folder, tmp_path / "cache", threads=1)
    assert [frame.camera.fx for frame in capture.frames] == pytest.approx([180, 180, 180, 225], rel=0.1)


def test_photos_with_too_few_features_are_told_as_such_before_none_is_related(room, tmp_path, caplog) -> None:
    blurred = [picture.filter(ImageFilter.GaussianBlur(6)) for picture in room]
    with pytest.raises(DataError, match="could be related"):
        photos.read(save_photos(tmp_path / "photos", blurred, 31), tmp_path / "cache", threads=1)
    assert "features or fewer: they are small, blurred, dark, or without texture" in caplog.text


def flat_photos(folder: Path, count: int) -> Path:
    folder.mkdir()
    for i in range(count):
        Image.new("RGB", (64, 48), (40 * i, 90, 120)).save(folder / f"{i}.png")
    return folder


def test_what_can_be_known_is_refused_before_the_long_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = flat_photos(tmp_path / "photos", 3)
    with pytest.raises(DataError, match="lies among the photos"):
        photos.read(folder, folder / "cache")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(DataError, match=r"clear-strategies\[colmap\]"):
        photos.read(folder, tmp_path / "cache")
    photo = folder / "0.png"
    for name, shown in ((os.fsdecode(b"caf\xe9.png"), r"caf\\udce9.png"), ("a\nb.png", r"a\\nb.png")):
        photo = photo.rename(folder / name)
        with pytest.raises(DataError, match=f"{shown}: name: must be UTF-8 without control characters.*rename"):
            photos.read(folder, tmp_path / "cache")


def test_a_pycolmap_that_does_not_run_here_is_told_as_one_that_is_not_installed(tmp_path, monkeypatch):
    (tmp_path / "pycolmap.py").write_text('raise RuntimeError("Cannot import the C++ backend")')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pycolmap")
    with pytest.raises(
        DataError, match=r"cannot be imported \(Cannot import the C\+\+ backend\).*clear-strategies\[colmap\]"
    ):
        features.import_pycolmap()


@pytest.mark.parametrize("swallowed", ["", "raise ImportError"])
def test_a_signal_while_pycolmap_is_imported_arrives_whatever_the_import_does_with_exceptions(
    swallowed, tmp_path, monkeypatch
):
    (tmp_path / "pycolmap.py").write_text(
        f"import signal\ntry:\n    signal.raise_signal(signal.SIGINT)\nexcept KeyboardInterrupt:\n    pass\n{swallowed}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pycolmap")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            features.import_pycolmap()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_disk_that_is_too_full_for_the_features_is_told_before_colmap_ends_the_process(tmp_path, monkeypatch):
    monkeypatch.setattr(features.shutil, "disk_usage", lambda _: SimpleNamespace(free=3 * 8192 * 320))
    with pytest.raises(OSError, match="No space left") as refused:
        photos.read(flat_photos(tmp_path / "photos", 3), tmp_path / "cache")
    assert refused.value.filename == str(tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


LIMITED = """
import os, re, resource, signal
from pathlib import Path
from clear_strategies.data.capture import Capture
from clear_strategies.data.readers import features, sfm
from clear_strategies.data.refined_poses import refined
features.import_pycolmap()
used = 1024 * int(re.search(r"VmSize:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
resource.setrlimit(resource.RLIMIT_AS, (used + (600 << 20), -1))
features._require_addresses(Path("here"), 1, "")
try:
    sfm.reconstruct(Path("here"), {}, Path("model"), sfm.SfmSettings(480, 2000, False, 2, 0))
except sfm.DataError as error:
    print(error, flush=True)
try:
    refined(Capture("given", ()), Path("cache"), features.SfmSettings(threads=2))
except sfm.DataError as error:
    print(error, flush=True)
os.kill(os.getpid(), signal.SIGTERM)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_less_memory_than_colmap_takes_is_told_and_a_signal_ends_the_process_without_a_stack_trace(tmp_path):
    """COLMAP's libraries would end the process without memory, or wait for ever, and print a stack trace of the signal."""
    ended = subprocess.run([sys.executable, "-c", LIMITED], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (-signal.SIGTERM, "")
    told = "memory: COLMAP takes up to 768 MB of addresses with 2 threads, and the system leaves this process less"
    remedy = "raise `ulimit -v`"
    assert ended.stdout == f"here: {told}: {remedy}, or set data.reader.threads=1\ngiven: {told}: {remedy}\n"


def database_of(
    file: Path, features: dict[int, int], pairs: dict[tuple[int, int], int]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """COLMAP's database of photos, by their number of features and of matches in pairs; keypoints and descriptors of each."""
    rng, kind = np.random.default_rng(0), pycolmap.FeatureExtractorType.SIFT
    found = [(rng.random((n, 6), np.float32), rng.integers(0, 255, (n, 128), np.uint8)) for n in features.values()]
    with pycolmap.Database.open(file) as database:
        camera = database.write_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 50.0, 64, 48))
        for number, (keypoints, descriptors) in zip(features, found, strict=True):
            image = database.write_image(pycolmap.Image(sfm.copy_name(number), camera_id=camera))
            database.write_keypoints(image, keypoints)
            database.write_descriptors(image, pycolmap.FeatureDescriptors(kind, descriptors))
        for (one, other), matches in pairs.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.zeros((matches, 2), np.uint32)
            database.write_two_view_geometry(one + 1, other + 1, geometry)  # COLMAP counts from 1
    return found


def photos_of_points(
    work: Path, centers: Sequence[Sequence[float]], focals: Sequence[float], known: float = 0.0, k1: float = 0.0
) -> tuple[dict, Path]:
    """Photos of 640x480, turned by up to 20 degrees, that share a camera; and COLMAP's database of their matched features, which
    are projections of 400 points with noise of 0.2 pixels. A `known` focal length is from as much further away.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -2, 4), (3, 2, 9), (400, 3))
    (work / "photos").mkdir()
    with pycolmap.Database.open(work / features.DATABASE) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", known or 768.0, 640, 480)
        camera.has_prior_focal_length = known > 0
        camera = database.write_camera(camera)
        for number, (center, focal) in enumerate(zip(centers, focals, strict=True)):
            Image.new("RGB", (640, 480)).save(work / "photos" / f"{number}.png")
            image = database.write_image(pycolmap.Image(sfm.copy_name(number), camera_id=camera))
            x, y, z = Rotation.from_euler("y", -8 * center[0], degrees=True).apply(points - center).T
            ray = np.stack((x, y), -1) / (z + 6.5 * max(0, known / 520 - 1))[:, None]
            ray *= 1 + k1 * (ray**2).sum(1, keepdims=True)
            seen = focal * ray + (320, 240) + rng.normal(size=(400, 2)) * 0.2
            database.write_keypoints(image, seen.astype(np.float32))
        for one, other in itertools.combinations(range(1, len(centers) + 1), 2):
            database.write_matches(one, other, np.arange(400, dtype=np.uint32)[:, None].repeat(2, 1))
    pycolmap.geometric_verification(work / features.DATABASE, pycolmap.GeometricVerifierOptions())
    return {path: read_header(path) for path in sorted((work / "photos").iterdir())}, work / features.DATABASE


@pytest.mark.parametrize(
    ("centers", "focals", "told"),
    [
        ([(0, 0, z) for z in (0, 0.7, 1.4, 2.1)], [520] * 4, ""),  # along the optical axis, one behind the other
        ([(x, 0, x * x / 8) for x in (-2, -1, 0, 1, 2)], [520, 800, 520, 800, 520], "the photos are zoomed"),
    ],
)
def test_photos_are_placed_however_the_camera_moves_and_zooms(
    centers, focals, told: str, tmp_path, monkeypatch, caplog, capfd
):
    files, database = photos_of_points(tmp_path, centers, focals)
    monkeypatch.setattr(pycolmap.logging, "minloglevel", pycolmap.logging.Level.FATAL.value)
    capfd.readouterr()
    monkeypatch.setattr(features, "find_and_match", lambda *_: database)
    (model,) = sfm._models(pycolmap, files, tmp_path, SfmSettings(threads=1))
    images = [model.images[number] for number in range(1, len(files) + 1)]
    lengths = np.array([model.cameras[image.camera_id].focal_length for image in images])
    # Along the axis, only the ratios can be known.
    assert lengths / lengths[0] == pytest.approx(np.divide(focals, focals[0]), rel=0.02)
    steps, true = (
        np.linalg.norm(np.asarray(c) - c[0], axis=1) for c in ([i.projection_center() for i in images], centers)
    )
    assert steps / steps[-1] == pytest.approx(true / true[-1], abs=0.01)
    assert (told in caplog.text) if told else not caplog.text
    assert not capfd.readouterr().err  # of COLMAP's log


def test_photos_of_a_long_lens_are_placed_though_its_k1_is_large(tmp_path, monkeypatch):
    """300 mm on 35 mm film, known by EXIF, with a distortion of 1 % at the corners."""
    focal, k1 = 5333.0, 0.01 / (400 / 5333) ** 2
    files, database = photos_of_points(tmp_path, [(x, 0, 0) for x in range(-3, 4)], [focal] * 7, known=focal, k1=k1)
    monkeypatch.setattr(features, "find_and_match", lambda *_: database)
    (model,) = sfm._models(pycolmap, files, tmp_path, SfmSettings(threads=1))
    assert model.num_reg_images() == 7
    assert [camera.params[3] for camera in model.cameras.values()] == pytest.approx([k1], rel=0.05)


def test_zoomed_photos_keep_their_poses_where_focal_lengths_of_their_own_give_none(tmp_path, monkeypatch, caplog):
    files, database = photos_of_points(tmp_path, [(x, 0, 0) for x in range(4)], [520] * 4)
    monkeypatch.setattr(features, "find_and_match", lambda *_: database)
    monkeypatch.setattr(sfm, "_ZOOM", 0)
    mapped, times = sfm._mapped, itertools.count()
    monkeypatch.setattr(sfm, "_mapped", lambda *args: [] if next(times) else mapped(*args))
    (model,) = sfm._models(pycolmap, files, tmp_path, SfmSettings(threads=1))
    assert model.num_reg_images() == 4
    assert "the photos are zoomed" in caplog.text
    assert "Poses may be wrong" in caplog.text


@pytest.mark.parametrize(
    "centers",
    [
        [(x / 10, 0, 0) for x in range(6)],  # the camera diverges: three photos were placed with it
        [(x / 5, 0, 0) for x in range(4)],  # no model at all
    ],
)
def test_too_little_parallax_is_told_as_such_where_photos_match_but_give_no_sound_model(
    centers, tmp_path, monkeypatch, caplog
):
    files, database = photos_of_points(tmp_path, centers, [520] * len(centers))
    monkeypatch.setattr(features, "find_and_match", lambda *_: database)
    monkeypatch.setattr(sfm, "_ZOOM", 0)  # focal lengths mean nothing without parallax
    with pytest.raises(DataError, match=r"too little parallax: .*: take a step to the side"):
        sfm._models(pycolmap, files, tmp_path, SfmSettings(threads=1))
    assert "zoomed" not in caplog.text


def test_a_model_without_points_counts_as_none() -> None:
    empty = pycolmap.Reconstruction()
    empty.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 768.0, 640, 480))
    for number in (1, 2, 3):
        photo = pycolmap.Image(sfm.copy_name(number), keypoints=np.zeros((5, 2)), camera_id=1, image_id=number)
        empty.add_image_with_trivial_frame(photo, pycolmap.Rigid3d())
    assert sfm._sound(pycolmap, [empty], 1.0) == []


def test_a_photo_without_a_pose_is_told_with_the_placed_photo_that_it_has_most_in_common_with(tmp_path: Path) -> None:
    pairs = {(0, 1): 300, (0, 2): 9, (1, 2): 14, (2, 3): 80}
    database_of(tmp_path / "database.db", {0: 1000, 1: 1000, 2: 1000, 3: 1000, 4: 7}, pairs)
    names = ["a.png", "b.png", "c.png", "d.png", "e.png"]
    assert sfm._unplaced(pycolmap, tmp_path / "database.db", names, {sfm.copy_name(0), sfm.copy_name(1)}) == {
        "c.png": "14 features in common with b.png, less with every other photo: more overlap",
        "d.png": "shares nothing with the placed photos: overlap by two thirds",
        "e.png": "7 features: blurred, dark, or without texture",
    }


@pytest.mark.parametrize(("placed", "count"), [(4, 10), (5, 12), (7, 100), (106, 1000)])
def test_too_few_placed_photos_are_refused_with_advice_and_the_setting_that_takes_them(placed: int, count: int) -> None:
    with pytest.raises(DataError, match=rf"only {placed} of the {count} photos .*overlap") as refused:
        sfm.require_placed(Path("mine"), placed, count, 0.5)
    least = float(str(refused.value).rpartition("data.reader.least_placed=")[2])
    assert least == pytest.approx(placed / count, abs=1e-3)
    sfm.require_placed(Path("mine"), placed, count, least)
    sfm.require_placed(Path("mine"), 6, 10, 0.5)


class FakeModel:
    """What `sfm` asks of a pycolmap.Reconstruction."""

    def __init__(self, *names: str) -> None:
        self.images = {i: SimpleNamespace(name=name) for i, name in enumerate(names)}

    def num_reg_images(self) -> int:
        return len(self.images)

    def write_binary(self, folder: str) -> None:
        (Path(folder) / "images.bin").write_text(",".join(image.name for image in self.images.values()))


@pytest.fixture
def estimate(tmp_path, monkeypatch):
    """Estimates the poses of ten photos, with a function in place of COLMAP's pipeline."""
    monkeypatch.setattr(sfm, "_unplaced", lambda *_: {})
    paths = [tmp_path / f"{i}.jpg" for i in range(10)]
    photos = {path: Header(path, (4, 3), 1, has_alpha=False, lossy=True, focal_35mm=None, lens=()) for path in paths}

    def run(mapping):
        monkeypatch.setattr(sfm, "_models", mapping)
        sfm.reconstruct(tmp_path, photos, tmp_path / "poses", SfmSettings(1600, 8192, False, threads=1, seed=0))

    return run


def test_the_largest_of_several_models_is_kept_and_a_full_disk_is_told(tmp_path, estimate, caplog):
    models = FakeModel("0", "1", "2"), FakeModel("3", "4", "5", "6", "7"), FakeModel("3", "4"), FakeModel("2", "8", "9")
    estimate(lambda *_: models)
    assert (tmp_path / "poses/images.bin").read_text() == "3,4,5,6,7"
    assert "groups that nothing connects (5, 3, 2 photos); the largest is used" in caplog.text

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "00000.jpg")

    with pytest.raises(OSError, match="No space left"):
        estimate(full)


def test_poses_that_another_run_has_estimated_meanwhile_are_kept(tmp_path, estimate):
    def slower(*_):
        (tmp_path / "poses").mkdir()
        (tmp_path / "poses/cameras.bin").write_text("of the other run")
        return [FakeModel("0", "1", "2")]

    estimate(slower)
    assert [(p.name, p.read_text()) for p in tmp_path.glob("poses*/*")] == [("cameras.bin", "of the other run")]


def test_folders_of_killed_runs_are_removed_from_the_cache_and_no_others(tmp_path, estimate):
    killed, works, kept = (tmp_path / name for name in ("0" * 24 + ".a_1bcdef", "1" * 24 + ".a_1bcdef", "my.photos"))
    for folder in (killed, works, kept):
        folder.mkdir()
        (folder / "database.db").touch()
    with files.hold(works):
        estimate(lambda *_: [FakeModel("0", "1", "2")])
    assert sorted(path.name for path in tmp_path.glob("*.*")) == [works.name, kept.name]
    assert (works / "database.db").exists()


def test_the_features_of_a_large_photo_begin_at_its_own_scale(tmp_path: Path) -> None:
    blobs = np.random.default_rng(0).integers(0, 255, (80, 107), np.uint8)
    (tmp_path / "copies").mkdir()
    for number in range(2):
        picture = Image.fromarray(blobs).resize((320, 240), Image.Resampling.BICUBIC)
        picture.convert("RGB").save(tmp_path / "copies" / sfm.copy_name(number))
    groups = {features.CopyCamera(320, 240): [sfm.copy_name(0), sfm.copy_name(1)]}
    settings = SfmSettings(max_side=1600, max_features=8192, precise=False, threads=1, seed=0)
    found = [features.find_features(pycolmap, tmp_path / f"{o}.db", groups, settings, octave=o) for o in (0, -1)]
    assert 100 < found[0] < found[1]


def test_no_photo_has_more_features_than_asked_for(tmp_path: Path) -> None:
    file = tmp_path / "database.db"
    found = database_of(file, {0: 3, 1: 7}, {})
    features.keep_coarsest(pycolmap, file, 5)
    with pycolmap.Database.open(file) as database:
        for image, (keypoints, descriptors) in enumerate(found, start=1):
            assert np.array_equal(database.read_keypoints(image), keypoints[:5])
            assert np.array_equal(database.read_descriptors(image).data, descriptors[:5])
