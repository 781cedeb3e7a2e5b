"""The strategies inside other trainers. Imports nothing of our own training loop, and no heavy library."""

from integration.autograd_shot import AutogradShot
from integration.errors import HostError
from integration.host_score import ScoreScaler
from integration.loss import joint_loss, joint_update
from integration.views import view

__all__ = ["AutogradShot", "HostError", "ScoreScaler", "joint_loss", "joint_update", "view"]
