"""Training strategies for 3D Gaussian Splatting from a few photos: GCO, P2G, SVS, pseudo views, and what carries them.

A strategy is a small object that answers questions about a training step. A `Conductor` asks the strategies in a fixed order
and merges the gradients. Each strategy works alone and with others, in the trainer of this package and in other trainers.

Each name is imported when it is first asked for, because most need torch, which takes seconds to import: `clear-strategies
--help` and a host that asks for little do not wait for it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from clear_strategies.core.conflicts import Products, Weights
    from clear_strategies.core.evidence import Evidence
    from clear_strategies.core.gradients import ATTRIBUTES, CONFLICT_GROUPS, Grads, ScreenGradients, Shot
    from clear_strategies.core.step import Step
    from clear_strategies.core.view import DepthMap, ExtraView, Photo, View
    from clear_strategies.density.mcmc import MCMC
    from clear_strategies.errors import AnchorError, ClearError, DataError, StrategyConflict
    from clear_strategies.merging.conductor import Conductor
    from clear_strategies.merging.iteration import Update
    from clear_strategies.merging.objective import Objective
    from clear_strategies.notebook import Run, train
    from clear_strategies.strategies.base import Strategy
    from clear_strategies.strategies.fading_opacity import FadingOpacity
    from clear_strategies.strategies.gco import GCO
    from clear_strategies.strategies.p2g import P2G
    from clear_strategies.strategies.pseudo_views import PseudoViews
    from clear_strategies.strategies.random_background import RandomBackground
    from clear_strategies.strategies.splatsure import SplatSuRe
    from clear_strategies.strategies.sr_stage import SRStage
    from clear_strategies.strategies.svs import SVS

__all__ = [
    "ATTRIBUTES", "CONFLICT_GROUPS", "GCO", "MCMC", "P2G", "SVS", "AnchorError", "ClearError", "Conductor", "DataError",
    "DepthMap", "Evidence", "ExtraView", "FadingOpacity", "Grads", "Objective", "Photo", "Products", "PseudoViews",
    "RandomBackground", "Run", "SRStage", "ScreenGradients", "Shot", "SplatSuRe", "Step", "Strategy", "StrategyConflict",
    "Update", "View", "Weights", "train",
]  # fmt: skip

__version__: str  # of the installed package

_NAMES: Final = {  # by the module of this package that they are defined in
    "core.conflicts": ("Products", "Weights"),
    "core.evidence": ("Evidence",),
    "core.gradients": ("ATTRIBUTES", "CONFLICT_GROUPS", "Grads", "ScreenGradients", "Shot"),
    "core.step": ("Step",),
    "core.view": ("DepthMap", "ExtraView", "Photo", "View"),
    "density.mcmc": ("MCMC",),
    "errors": ("AnchorError", "ClearError", "DataError", "StrategyConflict"),
    "merging.conductor": ("Conductor",),
    "merging.iteration": ("Update",),
    "merging.objective": ("Objective",),
    "notebook": ("Run", "train"),
    "strategies.base": ("Strategy",),
    "strategies.fading_opacity": ("FadingOpacity",),
    "strategies.gco": ("GCO",),
    "strategies.p2g": ("P2G",),
    "strategies.pseudo_views": ("PseudoViews",),
    "strategies.random_background": ("RandomBackground",),
    "strategies.splatsure": ("SplatSuRe",),
    "strategies.sr_stage": ("SRStage",),
    "strategies.svs": ("SVS",),
}
_HOMES: Final = {name: f"{__name__}.{module}" for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import one of `__all__`; called for names that the module does not have yet."""
    if name == "__version__":
        return _version()
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("clear-strategies")
    except metadata.PackageNotFoundError:  # on the path, and not installed
        return "source checkout"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
