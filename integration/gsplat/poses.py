"""Which training view a gsplat-style loop renders, where it does not say so: the one with that pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.errors import HostError
from integration.views import SAME_POSE

_POSE_RATIO: Final = 10  # how many times as far the second nearest pose must be, since frames of a video lie close


class Poses:
    """The poses of the training views."""

    def __init__(self, views: Sequence[View]) -> None:
        self._views = tuple(views)
        self._poses = torch.stack([view.lr.camera.world_to_camera for view in views]).double().cpu().numpy()

    def find(self, viewmats: Float[Tensor, "*C 4 4"]) -> View | None:
        """The view of this pose; None: it is none of a training view.

        Raises:
            HostError: there are several poses, or two views have this one.
        """
        poses = viewmats.detach().reshape(-1, 4, 4).cpu().numpy()  # compared in numpy: a step has few torch operations
        if len(poses) != 1:
            raise HostError(
                f"only one view per step is supported, got {len(poses)}. Set batch_size=1, or call joint_loss for each view "
                "and average."
            )
        distances = np.abs(self._poses - poses).max((1, 2)).tolist()
        tolerance = SAME_POSE * max(1.0, float(np.abs(poses).max()))
        near = sorted((distance, i) for i, distance in enumerate(distances) if distance <= tolerance)
        if len(near) > 1 and near[1][0] <= _POSE_RATIO * near[0][0]:
            names = " and ".join(self._views[i].name for _, i in near[:2])
            raise HostError(f"{names} have the same pose. Say which is rendered: with clear.rendering(view): …")
        return self._views[near[0][1]] if near else None
