"""Photos without poses: COLMAP's structure-from-motion on the CPU, through pycolmap (extra: colmap)."""

from __future__ import annotations

import hashlib
import logging
import math
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

from clear_strategies.core.checks import require_choice, require_number, require_whole
from clear_strategies.data.capture import MORE_PHOTOS, Capture
from clear_strategies.data.file_names import named, require_text, some
from clear_strategies.data.lenses import CUT
from clear_strategies.data.masks import masks_among
from clear_strategies.data.photo_files import SUFFIXES, Header, read_header
from clear_strategies.data.photo_folders import (
    folders_of_images,
    images_in,
    in_place_of_photos,
    list_images,
    photo_counts,
    usable,
)
from clear_strategies.data.priors import cache_folder
from clear_strategies.data.readers import colmap, features, sfm
from clear_strategies.data.readers.colmap_model import read_model
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_HEIC: Final = (".heic", ".heif")
_THUMBNAIL: Final = 64  # times as many pixels has the largest photo as one that is a preview
_HEAD: Final = 1 << 16  # bytes of a file by which its format is recognized
_LOOKED_INTO: Final = 50  # files of each pattern, at most
_CONVERT: Final = "ns-process-data {0} --data {{root}}{1} --output-dir converted"
_HERE: Final = "put the model into {root}/sparse/0"
_ABOVE: Final = "clear-strategies train {root}/.."
# Files of poses that no reader supports: their pattern, bytes that they contain, the tool, and how its poses can be used.
_OTHER_POSES: Final = (
    ("*.json", b'"frames"', "transforms.json", "clear-strategies train {file}"),
    ("*.xml", b"<document", "Metashape", _CONVERT.format("metashape", " --xml {file}")),
    ("*.csv", b"#name,x,y", "RealityCapture", _CONVERT.format("realitycapture", " --csv {file}")),
    ("*.xmp", b"xcr:", "RealityCapture", "export Cameras.txt, Images.txt and Points3D.txt (COLMAP) into {root}"),
    ("keyframes/cameras/*.json", b'"t_00"', "Polycam", _CONVERT.format("polycam", "")),
    ("cameras/*.json", b'"t_00"', "Polycam", _CONVERT.format("polycam", "/..")),
    ("metadata*", b'"poses"', "Record3D", _CONVERT.format("record3d", "")),
    ("poses_bounds.npy", b"NUMPY", "LLFF", "put the COLMAP model that they were made from into {root}/sparse/0"),
    *((f"{place}cameras.[bt]*", b"", "COLMAP", _HERE) for place in ("*/", "*/*/", "*/*/*/")),
    *((f"../{place}cameras.[bt]*", b"", "COLMAP", _ABOVE) for place in ("sparse/", "sparse/0/")),
    ("../transforms.json", b'"frames"', "transforms.json", _ABOVE),
)


def recognises(path: Path) -> int:
    """The lowest rank for any path, see `clear_strategies.commands.train.detect`: `read` refuses what contains no photos."""
    return int(path.exists())


def read(
    root: str | Path,
    cache: str | Path | None = None,
    *,
    max_side: int = 1600,
    max_features: int = 8192,
    precise: bool | Literal["auto"] = "auto",
    least_placed: float = 0.5,
    threads: int = -1,
    seed: int = 0,
    skip_faulty: bool = False,
) -> Capture:
    """Read a folder of photos of one scene. Poses are estimated from all of them and kept in a cache.

    Args:
        root: the folder; or one whose photos lie in its subfolder `images`, or in the only folder below it that holds any.
        cache: folder of the poses; None: ~/.cache/clear-strategies/sfm, or $CLEAR_CACHE/sfm. Not in the photos' folder.
        max_side: features are extracted from photos reduced to this many pixels.
        max_features: most features of a photo, of the coarsest scales; the time of matching grows with the square.
        precise: features that follow a surface's tilt (affine shape): more photos are placed, in about twice the time;
            "auto": for up to 30 photos.
        least_placed: the least share of the photos for which poses must be found.
        threads: number of threads of COLMAP; -1: all cores. With more than one, the poses' last digits may change from run to
            run.
        seed: seed of COLMAP's random samples.
        skip_faulty: leave out photos that are missing or damaged, with a warning for each; else they are an error.

    Raises:
        SettingError: a number is outside its range.
        DataError: too few photos, too few can be related to each other, or pycolmap is not installed.
    """
    require_whole("data.reader.max_side", max_side, least=1)
    require_whole("data.reader.max_features", max_features, least=1)
    require_choice("data.reader.precise", precise, (True, False, "auto"))
    require_number("data.reader.least_placed", least_placed, above=0, most=1)
    require_whole("data.reader.threads", threads, least=-1)
    require_whole("data.reader.seed", seed, least=0)
    root, name = Path(root), Path(root).resolve().name
    if root.is_file():
        raise DataError(root, "photos", "is a file", _instead_of(root))
    _warn_of_other_poses(root)
    root, images = _photos_in(root)
    base = Path(cache) if cache is not None else cache_folder() / "sfm"
    if base.resolve().is_relative_to(root.resolve()):
        raise DataError(root, "cache", f"{base} lies among the photos", "set data.reader.cache to a folder elsewhere")
    chosen = ((path.name, path) for path in _without_masks_and_twins(images))
    headers = {path: read_header(path) for _, path in usable(root, chosen, skip_faulty=skip_faulty)}
    photos = _without_thumbnails(headers)
    paths = list(photos)
    if all(width == 2 * height for width, height in (header.stored for header in photos.values())):
        message = (
            "%s: all photos are twice as wide as high. Of 360-degree panoramas, poses and splat would be wrong: %s."
        )
        _log.warning(message, root, CUT)
    require_text((name, *(path.name for path in paths)))
    if len(paths) < sfm.FEWEST:
        raise DataError(root, "images", f"there are {len(paths)}, poses need at least {sfm.FEWEST}", MORE_PHOTOS)
    precise = len(paths) <= features.PRECISE if precise == "auto" else precise
    folder = base / _cache_key(paths, max_side, max_features, precise, seed)
    if (folder / sfm.MODEL).is_file():
        _log.debug("%s: poses from the cache %s.", root, folder)
    else:
        sfm.reconstruct(root, photos, folder, features.SfmSettings(max_side, max_features, precise, threads, seed))
    capture = _capture(root, paths, folder)
    sfm.warn_unplaced(root, capture.unplaced, len(paths))
    sfm.require_placed(root, len(capture.frames), len(paths), least_placed)
    return replace(capture, name=name)


def _capture(root: Path, paths: Sequence[Path], folder: Path) -> Capture:
    """The capture of the photos that have a pose in `folder`."""
    model, photo_of = read_model(folder), {features.copy_name(i): path for i, path in enumerate(paths)}
    posed = {image.name: photo_of[image.name] for image in model.images}
    capture = colmap.capture(root, model, root, posed, upright=True, points="estimated here by pycolmap")
    poses = f"estimated by pycolmap from all {len(paths)} photos, {len(capture.frames)} could be placed"
    notes = {**capture.notes, "poses": poses, "photos": root.name}
    return replace(capture, notes=notes, unplaced=read_object(folder / sfm.UNPLACED))


def _instead_of(file: Path) -> str:
    """The remedy where a file is given in place of a folder."""
    if file.suffix.lower() in SUFFIXES:
        return f"give the folder of all photos: clear-strategies train {shlex.quote(str(file.parent))}"
    if other := in_place_of_photos([file]):
        return other[1]
    return "give the folder of the photos or of the capture"


def _photos_in(root: Path) -> tuple[Path, list[Path]]:
    """Choose the folder of the photos, and list them: of `root`, its folder `images` and the only folder below with images, the
    first that contains enough, else that with most.
    """
    below, images = folders_of_images(root), named(root, "images")
    found = {folder: images_in(folder) for folder in (root, images, *(below if len(below) == 1 else ()))}
    folder = max(found, key=lambda folder: min(len(found[folder]), sfm.FEWEST))  # the first of these
    if folder == root and below:
        _log.info("%s: the images in folders below it are not used: %s.", root, photo_counts(root, below))
    if folder not in (root, images) or (folder != root and found[root]):
        there = f"too few images ({len(found[root])})" if found[root] else "no image"
        _log.warning("%s holds %s; those in %s are used.", root, there, folder.relative_to(root).as_posix())
    stems = {path.stem for path in found[folder]}  # a phone saves a short clip, and a camera raw data, beside a photo
    if stems and (other := in_place_of_photos(p for p in sorted(folder.iterdir()) if p.stem not in stems)):
        _log.info("%s: not used: %s.", folder, other[0])
    return folder, found[folder] or list_images(folder)


def _warn_of_other_poses(root: Path) -> None:
    """Warn of poses in a format that is not read, since they are estimated anew; a DataError if no photos lie beside them."""
    if (sparse := named(root, "sparse")).is_dir():  # else `colmap` would read it
        _log.warning("%s holds no model (cameras.bin and images.bin, or .txt): the poses are estimated anew.", sparse)
    for pattern, content, tool, remedy in _OTHER_POSES:
        for file in filter(Path.is_file, sorted(root.glob(pattern))[:_LOOKED_INTO]):
            with file.open("rb") as opened:
                if content not in opened.read(_HEAD):
                    continue
            use = remedy.format(root=shlex.quote(str(root)), file=shlex.quote(str(file)))
            if not (images_in(root) or images_in(named(root, "images"))):
                raise DataError(file, "poses", f"are as {tool} has them, which is not read", f"to use them: {use}")
            _log.warning(
                "%s has poses as %s has them, which are not read: they are estimated anew, at another scale. To use them: %s",
                file, tool, use,
            )  # fmt: skip
            return


def _without_masks_and_twins(paths: Sequence[Path]) -> list[Path]:
    """The images without masks, and without HEIC files of photos that a phone has saved as JPEG, too."""
    masks, stems = set(masks_among(paths).values()), {path.stem for path in paths if path.suffix.lower() not in _HEIC}
    twice = {path for path in paths if path.suffix.lower() in _HEIC and path.stem in stems}
    for left, what in (
        (masks, "are masks of others"),
        (twice, "are not used, since their photos are there as JPEG, too"),
    ):
        if left:
            _log.info("%d of the images %s: %s.", len(left), what, some(sorted(path.name for path in left)))
    kept = [path for path in paths if path not in masks | twice]
    if same := [stem for stem, count in Counter(path.stem for path in kept).items() if count > 1]:
        raise DataError(kept[0].parent, "file name", f"{same[0]!r} has several files", "keep one file of each photo")
    return kept


def _without_thumbnails(headers: Mapping[Path, Header]) -> dict[Path, Header]:
    """The photos without those that are so small beside the largest that they are previews of others."""
    pixels = {path: math.prod(header.stored) for path, header in headers.items()}
    most = max(pixels.values(), default=0)
    small = [path for path, count in pixels.items() if _THUMBNAIL * count < most]
    if small:
        message = "%d of the images have less than 1/%d of the pixels of the largest, and are not used: %s."
        _log.warning(message, len(small), _THUMBNAIL, some([path.name for path in small]))
    return {path: header for path, header in headers.items() if path not in small}


def _cache_key(paths: Sequence[Path], *settings: int) -> str:
    version = (
        "upright copies, points of two views, affine, EXIF on trial, a camera a lens, forward motion, zoom, sound, tele"
    )
    digest = hashlib.sha256(repr((version, *settings)).encode())
    for path in paths:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:24]
