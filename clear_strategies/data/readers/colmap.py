"""Scene folders with a COLMAP sparse model and photos, such as LLFF's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from clear_strategies.core.checks import as_color
from clear_strategies.data.capture import BLACK, Capture, Frame, lens_notes, sorted_by_name
from clear_strategies.data.file_names import finder, is_file
from clear_strategies.data.masks import masks_of
from clear_strategies.data.photo_folders import folder_note, image_folder, images_in, usable
from clear_strategies.data.readers.colmap_model import Model, find_model, is_model, model_folders, read_model
from clear_strategies.errors import counted
from rasterizers.interface import Color


def recognises(path: Path) -> int:
    """The reader's rank for a path, see `clear_strategies.commands.train.detect`."""
    return 2 * any(map(is_model, model_folders(path)))


def read(
    root: str | Path, images: str | None = None, *, background: Color = BLACK, skip_faulty: bool = False
) -> Capture:
    """Read a scene folder with a sparse model in sparse/0, sparse, colmap/sparse/0 or the folder itself.

    Args:
        images: folder of the photos below root; None: the first that exists of images, images_2, images_4, images_8. Cameras are
            rescaled if the photos have another size than the model's. LLFF's scripts rename photos as they reduce them: beside a
            poses_bounds.npy, as many photos under other names are matched by their order.
        background: RGB in [0, 1] behind transparent pixels.
        skip_faulty: leave out photos that are missing or damaged, with a warning for each; else they are an error.

    Raises:
        SettingError: the background is no colour.
        DataError: the model or an image cannot be used.
    """
    root, background = Path(root), as_color("data.reader.background", background)
    model = read_model(find_model(root))
    folder = image_folder(root, images)
    find, notes = finder(folder), {}
    paths = {image.name: find(image.name) for image in model.images}
    if (root / "poses_bounds.npy").is_file() and not any(map(is_file, paths.values())):
        photos, first = images_in(folder), min(paths)
        if len(photos) == len(paths):
            paths = dict(zip(sorted(paths), photos, strict=True))
            notes["names"] = f"photos matched to the model's by order ({first} is {photos[0].name})"
    found = capture(root, model, folder, paths, background=background, skip_faulty=skip_faulty)
    return replace(found, notes=found.notes | notes)


def capture(
    root: Path,
    model: Model,
    folder: Path,
    paths: Mapping[str, Path],
    *,
    background: Color = BLACK,
    skip_faulty: bool = False,
    upright: bool | None = None,
    points: str = "",
) -> Capture:
    """Make the capture of a model and its photos.

    Args:
        folder: the folder of the photos.
        paths: the photos, below `folder`, by the model's names.
        upright: see `Frame.of_photo`.
        points: the origin of the model's points, for the plan; empty: its folder.

    Raises:
        DataError: an image cannot be used.
    """
    listing = model.listing
    listed = ((image, paths[image.name]) for image in model.images)
    photos = usable(listing, listed, skip_faulty=skip_faulty, scene=root)
    masks = masks_of(folder.parent, paths.values())
    frames = []
    for image, path in photos:
        inside = path.relative_to(folder) if path.is_relative_to(folder) else path  # which `sorted_by_name` refuses
        frames.append(Frame.of_photo(
            inside.as_posix(), path, model.lenses[image.camera], image.pose,
            upright=upright, background=background, sfm_id=image.id, mask=masks.get(path),
        ))  # fmt: skip
    below = model.folder.is_relative_to(root) and model.folder != root
    label = model.folder.relative_to(root).as_posix() if below else model.folder.name
    some_of = f" of its {len(model.images)}" if len(frames) < len(model.images) else ""
    notes = {
        "poses": f"COLMAP {label} ({listing.suffix[1:]}), {len(frames)}{some_of} images",
        "photos": folder_note(folder),
    }
    pattern = "**/*" if any(path.parent != folder for path in paths.values()) else "*"
    posed = {*paths.values(), *masks.values()}
    unposed = [path.relative_to(folder).as_posix() for path in images_in(folder, pattern) if path not in posed]
    if unposed:
        notes["without pose"] = f"{counted(len(unposed), 'photo')}, not used: {', '.join(unposed[:8])}"
    notes |= lens_notes(frames)
    sfm = None
    if count := len(model.points.means):
        source = f"COLMAP {points or label}, {count:,} points, triangulated from all {len(model.images)} images"
        sfm = replace(model.points, source=source)
    else:
        notes["points"] = "the model has none"
    lost = dict.fromkeys(unposed, "has no pose in the model")
    return Capture(root.resolve().name, sorted_by_name(frames, listing), sfm, background, notes, unplaced=lost)
