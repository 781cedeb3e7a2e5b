"""The strategies inside other trainers. Imports nothing of this package's training loop, and no heavy library."""

from clear_strategies.errors import HostError
from integration.autograd_shot import AutogradShot
from integration.densification import ScoreScaler
from integration.loss import extra_loss, joint_loss
from integration.views import view

__all__ = ["AutogradShot", "HostError", "ScoreScaler", "extra_loss", "joint_loss", "view"]
