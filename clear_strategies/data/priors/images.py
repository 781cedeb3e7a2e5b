"""SR images made by another program, e.g. ResShift, read from a folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.photo_files import read_header, read_image
from clear_strategies.data.priors.interface import AS_EXPECTED, checked_sr, require_path
from clear_strategies.data.view_names import ViewFiles


@dataclass(frozen=True, slots=True)
class Images:
    """A folder with one file per view: `<the view's name without its ending>[suffix].<png, jpg …>`.

    A view whose name has a folder (cam1/0001.png) has its file in the subfolder of that name, or in `path` itself.

    Args:
        path: the folder.
        suffix: what the SR program appended to the file names, e.g. "_x4".

    Raises:
        SettingError: no path is given.
        DataError: at a call, if a view has no file, or shares one with another view.
    """

    path: str = ""
    suffix: str = ""
    _files: ViewFiles = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require_path(self.path, "the folder of the SR images")
        remedy = "name the SR images like the views, or set prior.suffix"
        resize = "super-resolve the very LR images of this run, which data.save_lr or a host's save_lr writes"
        object.__setattr__(self, "_files", ViewFiles(Path(self.path), "SR image", remedy, resize, self.suffix))

    @property
    def label(self) -> str:
        return f"images {self.path}"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        file = self._files.file(name, lr.shape[1] * factor, lr.shape[0] * factor)
        over_black = "its transparent pixels are black in the photos, too; else save it without alpha"
        check = over_black if read_header(file).has_alpha else AS_EXPECTED
        return checked_sr(file.name, read_image(file), lr, factor, check)
