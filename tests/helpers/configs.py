"""The configuration of conf/ with some overrides, and the options that it offers."""

import copy
from collections.abc import Sequence
from functools import cache

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import create_config_search_path
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import setup_globals
from hydra.types import RunMode
from hydra.version import setbase
from omegaconf import DictConfig, open_dict

from clear_strategies.options import CONF


def composed(*overrides: str, hydra: bool = False) -> DictConfig:
    """As the command line composes it; with `hydra`, the node of that name too."""
    config = copy.deepcopy(_composed(overrides))  # in a twentieth of the time of composing
    if not hydra:
        with open_dict(config):
            del config["hydra"]
    return config


@cache
def _composed(overrides: Sequence[str]) -> DictConfig:
    return loader().load_configuration("config", list(overrides), run_mode=RunMode.RUN)


def options(group: str) -> list[str]:
    """The choices of a group, without those that others build on."""
    return sorted(p.stem for p in (CONF / group).glob("*.yaml") if not p.stem.startswith("_"))


@cache
def loader() -> ConfigLoaderImpl:
    """Hydra's, of conf/; all tests share it, for making one takes a third of the time of composing."""
    setbase("1.3")
    setup_globals()
    Plugins.instance()
    return ConfigLoaderImpl(create_config_search_path(str(CONF)))


def jobs_of(whole: DictConfig, overrides: Sequence[str]) -> Sequence[Sequence[str]]:
    """The overrides of each job that Hydra's sweeper makes of these; `whole` is the configuration of the sweep."""
    swept = [f"{key}={value}" for key, value in (whole.hydra.sweeper.params or {}).items()]
    (jobs,) = BasicSweeper.split_arguments(OverridesParser.create(loader()).parse_overrides([*swept, *overrides]), None)
    return jobs
