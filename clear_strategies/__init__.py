"""What to do with the gradients of Gaussians: CLEAR's strategies, and what carries them.

A strategy is a small object that answers questions about a 3D Gaussian Splatting step; a `Conductor` asks them in the
paper's order and merges the gradients. GCO, P2G and SVS work alone and together, in our trainer and in others'.
"""

from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import ATTRIBUTES, CONFLICT_GROUPS, Grads, Shot
from clear_strategies.errors import AnchorError, ClearError, DataError, StrategyConflict
from clear_strategies.merging.conductor import Conductor, Update
from clear_strategies.merging.objective import Objective
from clear_strategies.strategies.base import ScreenGradients, Strategy
from clear_strategies.strategies.gco import GCO
from clear_strategies.strategies.p2g import P2G
from clear_strategies.strategies.splatsure import SplatSuRe
from clear_strategies.strategies.svs import SVS

__all__ = [
    "ATTRIBUTES",
    "CONFLICT_GROUPS",
    "GCO",
    "P2G",
    "SVS",
    "AnchorError",
    "ClearError",
    "Conductor",
    "DataError",
    "Evidence",
    "Grads",
    "Objective",
    "ScreenGradients",
    "Shot",
    "SplatSuRe",
    "Strategy",
    "StrategyConflict",
    "Update",
]
