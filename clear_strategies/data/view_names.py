"""Names of views and of their files. Photos in different folders may have the same file name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.file_names import name_key, named, normalized
from clear_strategies.data.photo_files import SUFFIXES, png_bytes, read_header
from clear_strategies.data.photo_folders import list_images
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes, write_bytes


def bare(name: str) -> str:
    """The name without the suffix of an image: "cam1/0001" of "cam1/0001.png", and "rgb.0001" of "rgb.0001"."""
    stem, dot, suffix = name.rpartition(".")
    return stem if f"{dot}{suffix}".lower() in SUFFIXES else name


def file_stems(names: Iterable[str]) -> dict[str, str]:
    """Unique file stems for a flat folder, by the views' names: "cam1_0001" for "cam1/0001.png". Views whose stems would be equal
    without regard to case keep their suffixes: "0000.jpg" and "0000.png".
    """
    stems = {name: bare(name).replace("/", "_") for name in names}
    shared, taken = Counter(map(name_key, stems.values())), set[str]()
    for name, stem in sorted(stems.items()):
        stems[name] = name.replace("/", "_") if shared[name_key(stem)] > 1 else stem
        while name_key(stems[name]) in taken:
            stems[name] += "_"
        taken.add(name_key(stems[name]))
    return stems


def matching(names: Sequence[str], wanted: str) -> list[str]:
    """The names that equal `wanted`, with or without suffix; if there is none, those whose file name equals it."""
    wanted = normalized(wanted)

    def is_wanted(name: str) -> bool:
        return wanted in (name, bare(name)) or name == bare(wanted)  # the names of a Blender scene have no suffix

    return list(filter(is_wanted, names)) or [name for name in names if is_wanted(_file_name(name))]


def write_pngs(folder: Path, images: Iterable[tuple[str, Float[Tensor, "h w 3"]]]) -> int:
    """Write images by their views' names, and return how many. `ViewFiles` finds files of the same names.

    Raises:
        DataError: two views have the same name, or a file of that name contains another image, such as the photo itself.
    """
    written = dict[str, str]()
    for name, image in images:
        stem = bare(name) if name_key(bare(name)) not in written.values() else name
        file, png = folder / f"{stem}.png", png_bytes(image)
        if name in written or name_key(stem) in written.values():
            raise DataError(file, "file name", "is that of two photos", "give every photo its own name")
        if file.exists() and read_bytes(file) != png:
            raise DataError(file, "file", "is there, and holds another image", "give another folder, or move the file")
        write_bytes(file, png)
        written[name] = name_key(stem)
    return len(written)


@dataclass(frozen=True, slots=True)
class ViewFiles:
    """A folder with one image, or one file of other `suffixes`, per view, see `clear_strategies.data.priors.Images`."""

    folder: Path
    what: str  # a noun for one of the images, for messages
    remedy: str  # for a missing file
    resize: str  # the remedy for one of another size
    suffix: str = ""  # of the files' stems
    suffixes: Sequence[str] = SUFFIXES
    _view_of: dict[Path, str] = field(default_factory=dict, init=False)
    _listed: dict[Path, dict[str, list[Path]]] = field(default_factory=dict, init=False)

    def file(self, name: str, width: int, height: int) -> Path:
        """Find the image of the view, as `find` does; a DataError if it has another size."""
        path = self.find(name)
        if (size := read_header(path).size(None)) != (width, height):
            problem = f"is {size[0]}x{size[1]} where {width}x{height} is expected"
            raise DataError(path, "size", problem, self.resize)
        return path

    def find(self, name: str) -> Path:
        """Find the file of the view; a DataError if there is none or several, or it is that of another view."""
        folder, _, stem = bare(name := normalized(name)).rpartition("/")
        below, whole = named(self.folder, folder), _file_name(name) + self.suffix
        inside, file_stem = below if below.is_dir() else self.folder, stem + self.suffix
        if self._listed.get(inside, {}).keys().isdisjoint((file_stem, whole)):
            self._listed[inside] = {}
            for path in list_images(inside, self.suffixes):
                self._listed[inside].setdefault(normalized(path.stem), []).append(path)
        files = self._listed[inside].get(whole) or self._listed[inside].get(file_stem, [])
        if len(files) != 1:
            problem, remedy = f"has no {self.what} {file_stem} ({', '.join(self.suffixes)})", self.remedy
            if files:
                problem, remedy = f"has {' and '.join(file.name for file in files)} for one view", "keep one of them"
            raise DataError(inside, stem, problem, remedy)
        if (other := self._view_of.setdefault(files[0], name)) != name:
            problem = f"would be that of two views, {other} and {name}"
            remedy = f"put the {self.what}s into subfolders like those of the photos"
            raise DataError(files[0], self.what, problem, remedy)
        return files[0]


def _file_name(name: str) -> str:
    return name.rpartition("/")[2]
