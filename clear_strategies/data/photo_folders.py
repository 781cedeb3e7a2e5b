"""Finding the photos of a folder or a capture, and selecting those that can be used."""

from __future__ import annotations

import logging
import os
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar

from clear_strategies.data.file_names import LISTED, is_file, named, some
from clear_strategies.data.photo_files import SUFFIXES, read_image
from clear_strategies.errors import DataError, one_line

T = TypeVar("T")

_log = logging.getLogger(__name__)

_FOLDERS: Final = ("images", "images_2", "images_4", "images_8")
_BELOW: Final = ("*/*", "*/*/*")  # a memory card has DCIM/100CANON
_NO_PHOTOS: Final = ("mask", "masks")  # names of folders
FRAMES: Final = "ffmpeg -i FILE -vf thumbnail=15 -fps_mode passthrough -q:v 2 FOLDER/%03d.jpg"
HDR: Final = "-vf thumbnail=15,scale=out_primaries=bt709:out_transfer=iec61966-2-1,format=rgb24 (ffmpeg 8)"
# Kinds of files that folders contain in place of photos: their suffixes, and how to convert them.
_OTHER_KINDS: Final = {
    "raw photos": (
        ".3fr .arw .cr2 .cr3 .dng .nef .orf .pef .raf .raw .rw2 .srw",
        "develop them, all alike, to TIFF or JPEG: darktable-cli FILE FOLDER/FILE.tif for each, or a batch of RawTherapee",
    ),
    "videos": (
        ".avi .insv .m4v .mkv .mov .mp4 .mts .webm",
        f"give a folder of photos; of a video: {FRAMES}; of one in HDR: {HDR}",
    ),
    "archives": (".7z .gz .rar .tar .tgz .xz .zip", "unpack them, and give the folder: unzip FILE -d FOLDER, or tar -xf FILE"),
    "splats or points": (".ply .sog .splat .spz", "give a folder of photos; clear-strategies view FILE shows a PLY"),
    "images of another format": (
        ".avif .bmp .exr .gif .hdr .jxl .jp2 .psd .tga",
        "save them as PNG or JPEG: mogrify -format png FILE",
    ),
}  # fmt: skip


def image_folder(root: Path, name: str | None = None) -> Path:
    """Return the folder of photos in `root`. Without a name, it is the first of images, images_2, images_4 and images_8 that
    exists, else `root` itself, else the only folder below it that contains images.
    """
    present = [folder for name in _FOLDERS if (folder := named(root, name)).is_dir()]
    if name is not None:
        if not (folder := named(root, name)).is_dir():
            remedy = f"choose one of {', '.join(path.name for path in present)}" if present else "check the path"
            raise DataError(folder, "images", "is no folder", remedy)
        return folder
    if present or images_in(root):
        return present[0] if present else root
    problem, remedy = (
        f"has none of the folders {', '.join(_FOLDERS)}",
        "name the folder of photos: data.reader.images=FOLDER",
    )
    if len(others := folders_of_images(root)) == 1:
        return next(iter(others))
    raise DataError(root, "images", f"{problem}, but {photo_counts(root, others)}" if others else problem, remedy)


def folder_note(folder: Path) -> str:
    """The folder's name, and the names of other folders of photos beside it, for the plan."""
    others = [name for name in _FOLDERS if name != folder.name and (folder.parent / name).is_dir()]
    return f"{folder.name} (there are also {', '.join(others)})" if others else folder.name


def list_images(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    """List the image files of a folder, by their suffix, in order of names, without hidden files. If there is none, the DataError
    names what the folder contains instead.
    """
    if not folder.is_dir():
        raise DataError(folder, "folder", "is a file" if folder.exists() else "is not there", "check the path")
    if images := images_in(folder, suffixes=suffixes):
        return images
    problem, remedy = f"holds no image ({', '.join(suffixes)})", "check the path"
    if inside := folders_of_images(folder):
        problem = f"{problem}, but {photo_counts(folder, inside)}"
        remedy = "give one of these folders, or put all photos of the scene into one"
    elif other := in_place_of_photos(path for pattern in ("*", *_BELOW) for path in sorted(folder.glob(pattern))):
        problem, remedy = f"{problem}, but {other[0]}", other[1]
    raise DataError(folder, "images", problem, remedy)


def folders_of_images(root: Path) -> dict[Path, int]:
    """Count the images in each folder that lies up to two levels below this one; folders of masks are left out."""
    images = [path for pattern in _BELOW for path in images_in(root, pattern)]
    return dict(Counter(path.parent for path in images if path.parent.name.lower() not in _NO_PHOTOS))


def photo_counts(root: Path, folders: Mapping[Path, int]) -> str:
    """Describe folders and the numbers of their photos, the largest first."""
    most = sorted(folders.items(), key=lambda item: -item[1])
    return some([f"{folder.relative_to(root).as_posix()} holds {count}" for folder, count in most])


def in_place_of_photos(paths: Iterable[Path]) -> tuple[str, str] | None:
    """Describe the most frequent known kind of these files, and how to convert it to photos; None if no kind is known."""
    kind_of = {ending: kind for kind, (endings, _) in _OTHER_KINDS.items() for ending in endings.split()}
    of_kind = dict[str, list[Path]]()
    for path in paths:
        if (kind := kind_of.get(path.suffix.lower())) and path.is_file() and not path.name.startswith("."):
            of_kind.setdefault(kind, []).append(path)
    if not of_kind:
        return None
    kind, found = max(of_kind.items(), key=lambda item: len(item[1]))
    remedy = _OTHER_KINDS[kind][1].replace("FILE", shlex.quote(found[0].name))
    return f"{kind} ({len(found)}): {some([path.name for path in found])}", remedy


def images_in(folder: Path, pattern: str = "*", suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    """List images as `list_images` does, possibly none; the pattern "**/*" includes the folders below."""
    images = sorted(p for p in folder.glob(pattern) if p.suffix.lower() in suffixes and p.is_file())
    return [p for p in images if not any(part.startswith(".") for part in p.relative_to(folder).parts)]


def usable(
    listing: Path, photos: Iterable[tuple[T, Path]], *, skip_faulty: bool, scene: Path | None = None
) -> list[tuple[T, Path]]:
    """Select the photos that can be used, in order.

    Args:
        photos: each with what the reader knows of it.
        listing: the file or folder that lists the photos, for messages.
        scene: the folder that data.reader.images is relative to; None: the reader has no such setting.
        skip_faulty: decode every photo, and leave out those that are missing or cannot be decoded, with a warning for each.
            Else no photo is decoded: a damaged one fails when it is loaded, and a missing one is a DataError.
    """

    def decodes(path: Path) -> bool:
        try:
            read_image(path, turn=True)
        except DataError as error:
            _log.warning("skipped: %s: %s: %s", error.file, error.field, one_line(error.problem))
            return False
        return True

    photos = list(photos)
    absent = [path for _, path in photos if not is_file(path)]
    if absent and len(absent) == len(photos):
        raise _none_found(listing, absent, scene)
    if absent and not skip_faulty:
        problem = f"{len(absent)} of {len(photos)} are not there: {some([path.name for path in absent])}"
        remedy = "put them back, or train without them: data.reader.skip_faulty=true"
        raise DataError(listing, "photos", problem, remedy)
    kept = [photo for photo in photos if not skip_faulty or decodes(photo[1])]
    if photos and not kept:
        raise DataError(listing, "photos", f"none of {len(photos)} can be used", "check the path")
    return kept


def _none_found(listing: Path, absent: Sequence[Path], scene: Path | None) -> DataError:
    """The error for a list of which no photo exists; it names the folder that was searched, and what that contains."""
    searched = next(folder for folder in absent[0].parents if folder.is_dir())
    remedy = f"give the photos these names, or correct those in {listing.name}"
    if photos := images_in(searched) or images_in(searched, "*/*"):
        found = f"{len(photos)} others, such as {some([photos[0].relative_to(searched).as_posix()])}"
        other = photos[0].parent
        if scene is not None:
            setting = "name the folder of the photos: data.reader.images="
            inside = shlex.quote(Path(os.path.relpath(other, scene)).as_posix())
            remedy = f"{setting}FOLDER, or {remedy}" if other == searched else f"{setting}{inside}"
    else:
        endings = Counter(path.suffix or path.name for path in sorted(searched.iterdir()))
        found = ", ".join(f"{count} {ending}" for ending, count in endings.most_common(LISTED)) or "nothing"
        remedy = "put the photos there, as PNG or JPEG"
    missing = some([absent[0].relative_to(searched).as_posix()])
    problem = f"none of {len(absent)} is in {searched}, such as {missing}; it holds {found}"
    return DataError(listing, "photos", problem, remedy)
