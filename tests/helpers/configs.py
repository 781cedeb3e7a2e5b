"""The configuration of conf/ with some overrides, and the options that it offers."""

from __future__ import annotations

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from clear_strategies.compose import CONF


def composed(*overrides: str, hydra: bool = False) -> DictConfig:
    """As the command line composes it; with `hydra`, the node of that name too."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", list(overrides), return_hydra_config=hydra)


def options(group: str) -> list[str]:
    """The choices of a group, without those that others build on."""
    return sorted(p.stem for p in (CONF / group).glob("*.yaml") if not p.stem.startswith("_"))
