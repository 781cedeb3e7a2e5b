"""nerfstudio's data manager of whole photos, with initial points by stereo on demand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig

from clear_strategies.console import show_in_host
from integration.nerfstudio.data import seed_with_stereo
from integration.points import wants_stereo


@dataclass
class ClearDatamanagerConfig(FullImageDatamanagerConfig):  # type: ignore[misc]
    """nerfstudio's settings, and whose points the Gaussians start from.

    Raises:
        SettingError: `points` is neither own nor stereo.
    """

    _target: type = field(default_factory=lambda: ClearDatamanager)
    points: Literal["own", "stereo"] = "own"
    """own: the data set's points; stereo: dense stereo between the training photos"""

    def __post_init__(self) -> None:
        wants_stereo(self.points)


class ClearDatamanager(FullImageDatamanager):  # type: ignore[misc]
    """nerfstudio's data manager; for training with points=stereo, the data set's points are replaced."""

    config: ClearDatamanagerConfig

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if wants_stereo(self.config.points) and self.test_mode == "val":  # otherwise a checkpoint has the Gaussians
            show_in_host()
            seed_with_stereo(self)
