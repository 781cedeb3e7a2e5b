"""Priors, which make the super-resolved (SR) image of each view. One file per prior."""

from clear_strategies.data.priors.back_projected import BackProjected
from clear_strategies.data.priors.corrupted import Corrupted, DemoPrior
from clear_strategies.data.priors.images import Images
from clear_strategies.data.priors.interface import (
    Bicubic,
    Cached,
    Network,
    Prior,
    cache_folder,
    cached,
    fingerprint,
    network_of,
    super_resolved,
)
from clear_strategies.data.priors.ncnn import Ncnn
from clear_strategies.data.priors.onnx import Onnx

__all__ = [
    "BackProjected", "Bicubic", "Cached", "Corrupted", "DemoPrior", "Images", "Ncnn", "Network", "Onnx",
    "Prior", "cache_folder", "cached", "fingerprint", "network_of", "super_resolved",
]  # fmt: skip
