"""Training strategies for 3D Gaussian Splatting from a few photos: GCO, P2G, SVS, pseudo views, and what carries them.

A strategy is a small object that answers questions about a training step. A `Conductor` asks the strategies in a fixed order
and merges the gradients. Each strategy works alone and with others, in the trainer of this package and in other trainers.
"""

from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import ATTRIBUTES, CONFLICT_GROUPS, Grads, Shot
from clear_strategies.core.step import Step
from clear_strategies.core.view import DepthMap, ExtraView, Photo, View
from clear_strategies.errors import AnchorError, ClearError, DataError, StrategyConflict
from clear_strategies.merging.conductor import Conductor, Update
from clear_strategies.merging.objective import Objective
from clear_strategies.strategies.base import ScreenGradients, Strategy
from clear_strategies.strategies.gco import GCO
from clear_strategies.strategies.p2g import P2G
from clear_strategies.strategies.pseudo_views import PseudoViews
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
    "DepthMap",
    "Evidence",
    "ExtraView",
    "Grads",
    "Objective",
    "Photo",
    "PseudoViews",
    "ScreenGradients",
    "Shot",
    "SplatSuRe",
    "Step",
    "Strategy",
    "StrategyConflict",
    "Update",
    "View",
]
