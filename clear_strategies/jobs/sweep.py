"""Sweeps of jobs: checks before the first job, and signals to the jobs that joblib runs in processes of their own."""

from __future__ import annotations

import functools
import multiprocessing
import os
import re
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, Final

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import OmegaConfBaseException

from clear_strategies import signals
from clear_strategies.errors import ClearError, DataError, SettingError
from clear_strategies.files import FINISHED, expanded
from clear_strategies.hydra_errors import require_option
from clear_strategies.options import UNNAMED
from clear_strategies.settings import absent, missing

# Launchers whose jobs share the file system of the process that was started; nodes of a cluster may have another.
_LOCAL: Final = ("basic", "cores", "joblib", "submitit_local")


def in_sweep() -> bool:
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def refusal(config: DictConfig) -> str | None:
    """The reason why a sweep cannot begin: a job is in it twice, a value is no option, or all jobs lack the same value,
    folder or file; else None.

    Jobs are composed until one lacks nothing, or something else than the first.

    Args:
        config: of the sweep, as Hydra passes it to callbacks.
    """
    try:
        for word in _words(config):  # those of an experiment's file; of the others `hydra_app.readable` has told
            require_option(word)
        jobs = Counter(map(tuple, _overrides_of_jobs(config)))
        if _has_default_folders(config) and (twice := next((job for job, count in jobs.items() if count > 1), None)):
            return (
                f"{' '.join(twice)}: stands twice in this sweep, and has one folder. Name each value once; "
                "hydra.sweep.subdir='${hydra.job.num}' gives each job a folder of its own."
            )
        lacks = map(_lack, _jobs(config))
        first = next(lacks, None)
        return first if first and all(lack == first for lack in lacks) else None
    except SettingError as error:
        return str(error)
    except (HydraException, OmegaConfBaseException, OSError):
        return None  # Hydra, which composes all jobs next, or the jobs raise the error


def leave_out_what_methods_set_aside(config: DictConfig) -> str | None:
    """Sweep no strategies that each method of the sweep sets aside: the jobs of one method would all be the same run.

    Args:
        config: as of `refusal`.

    Returns:
        The reason why the sweep cannot begin: only some of its methods set the strategies aside; else None.
    """
    if config.hydra.runtime.choices["hydra/sweeper"] != "basic":  # others may have no `params`
        return None
    words = {word.key_or_group: word for word in _words(config)}
    strategy, method = words.get("strategy"), words.get("method")
    if strategy is None or method is None or not strategy.is_sweep_override():
        return None
    of_strategy, of_method = (f"{word.get_key_element()}=" for word in (strategy, method))
    baseline, jobs = f"{of_strategy}baseline", dict[str, list[str]]()  # a job of each method, with another strategy
    for job in _overrides_of_jobs(config):
        if baseline not in job:
            jobs[next(word for word in job if word.startswith(of_method))] = job

    def is_set_aside(job: list[str]) -> bool:
        alone = [baseline if word.startswith(of_strategy) else word for word in job]
        return bool(_strategies_of(config, job) == _strategies_of(config, alone))

    with suppress(HydraException, OmegaConfBaseException):  # Hydra, which composes all jobs next, raises the error
        aside = [method for method, job in jobs.items() if is_set_aside(job)]
        if len(aside) == len(jobs):
            with read_write(config.hydra):  # of one key the last counts
                config.hydra.overrides.task.append(baseline)
        elif aside and _has_default_folders(config):
            return (
                f"{aside[0]}: sets strategies aside, so that this sweep would train it once for each of them, in one folder. "
                f"Sweep it by a command of its own, without {of_strategy}…; both may have one hydra.sweep.dir."
            )
    return None


def name_by_all_that_is_swept(config: DictConfig) -> None:
    """Add settings that the names of the jobs' folders leave out by default to these names, if the sweep varies them.

    Args:
        config: as of `refusal`.
    """
    if _has_default_folders(config) and (
        swept := UNNAMED & {word.key_or_group for word in _words(config) if word.is_sweep_override()}
    ):
        with read_write(config.hydra):
            config.hydra.overrides.hydra.append(f"hydra.sweep.subdir='${{job_folder:{','.join(sorted(swept))}}}'")


def _has_default_folders(config: DictConfig) -> bool:
    """Return True if the folders of the jobs are named by their overrides, which is the default."""
    given: Any = OmegaConf.to_container(config.hydra.sweep)
    return bool(given["subdir"] == "${job_folder:}")


def _words(config: DictConfig) -> list[Override]:
    """The overrides of a sweep, those of its file included."""
    hydra = config.hydra
    words = [*(f"{key}={values}" for key, values in (hydra.sweeper.params or {}).items()), *hydra.overrides.task]
    return OverridesParser.create(GlobalHydra.instance().config_loader()).parse_overrides(words)


def _overrides_of_jobs(config: DictConfig) -> list[list[str]]:
    """The overrides of each job; empty if another sweeper than Hydra's own chooses the values."""
    if config.hydra.runtime.choices["hydra/sweeper"] != "basic":
        return []
    (jobs,) = BasicSweeper.split_arguments(_words(config), None)
    return jobs


def _strategies_of(config: DictConfig, overrides: list[str]) -> Any:
    """The strategies and what wraps them, by these overrides."""
    job = GlobalHydra.instance().config_loader().load_sweep_config(config, overrides)
    return job.get("strategies"), job.get("decorators")


def _jobs(config: DictConfig) -> Iterator[DictConfig]:
    """The configuration of each job, but for its `hydra`. Jobs that choose the same options share a composition, which takes
    0.2 s, and the values of each are set in it.
    """
    shared: dict[tuple[str, ...], DictConfig] = {}
    for overrides in _overrides_of_jobs(config):
        values, choices = dict[str, Any](), list[str]()
        for text, word in zip(overrides, OverridesParser.create().parse_overrides(overrides), strict=True):
            is_value = word.type == OverrideType.CHANGE and "." in word.key_or_group and not word.is_hydra_override()
            if is_value and not isinstance(word.value(), dict):
                values[word.key_or_group] = word.value()
            else:
                choices.append(text)
        if (key := (*choices, *values)) not in shared:
            shared[key] = GlobalHydra.instance().config_loader().load_sweep_config(config, overrides)
        for name, value in values.items():
            OmegaConf.update(shared[key], name, value)
        yield shared[key]


def _lack(config: DictConfig) -> str | None:
    """The message about a value, folder or file that a job lacks; None if it lacks nothing."""
    values: dict[str, Any] = OmegaConf.to_container(config)  # type: ignore[assignment]
    if (key := absent({name: node for name, node in values.items() if name != "hydra"})) is not None:
        return str(missing(key))
    if config.hydra.runtime.choices["hydra/launcher"] not in _LOCAL:
        return None
    if config.fit.resume == "auto" and any(Path(config.hydra.sweep.dir).rglob(FINISHED)):
        return None  # a job that has finished reads nothing
    try:
        require_paths(functools.partial(OmegaConf.select, config))
    except DataError as error:
        return str(error)
    return None


def require_paths(setting: Callable[[str], Any]) -> None:
    """Raise a DataError if a folder or file of the scene or of its SR images is not there.

    It names the first folder of a path that is not there, which is the same for all scenes of a wrong data.root.

    Args:
        setting: the value of a dotted key; None where the configuration has no such key.
    """
    given = {"data.cloud.path": setting("data.cloud.init") == "ply", "prior.path": setting("data.save_lr") is None}
    for key in ("data.root", "data.path", *(name for name, is_read in given.items() if is_read)):
        if path := setting(key):
            whole = Path(expanded(str(path)))
            if gone := [part for part in (*reversed(whole.parents), whole) if not part.exists()]:
                raise DataError(gone[0], key, "is not there", "correct the path")


def in_worker() -> bool:
    """Return True in a process of joblib's, which ends all others as soon as one of them ends or has an error."""
    return in_sweep() and multiprocessing.parent_process() is not None


@contextmanager
def first_signal_ends_job() -> Iterator[None]:
    """During a job in a process of joblib's, let the first signal end the job after it has saved."""
    if not in_worker():
        yield
        return
    signals.handle(_end_job)
    try:
        yield
    finally:
        signals.handle(lambda signum, _: signals.told.append(signum))  # between two jobs


def _end_job(signum: int, frame: FrameType | None) -> None:
    """The handler of joblib's processes during a job, outside steps that defer signals."""
    if not signals.told and not signals.asked():
        signals.stop(signum, frame)


def worker_ended(error: BrokenProcessPool) -> ClearError:
    """The error if one of joblib's processes has ended before its job: joblib ends the others, too."""
    how = re.search(r"\{(.*)\}", str(error))  # joblib's: "The exit codes of the workers are {SIGKILL(-9)}"
    return ClearError(
        f"a process of the sweep was ended ({how[1] if how else 'unknown'}), as the system does where memory runs out (SIGKILL). "
        "Finished jobs stay; the others go on from their checkpoints with fit.resume=auto and the same hydra.sweep.dir. "
        "Lower hydra.launcher.n_jobs."
    )


def stop_workers(signum: int, frame: FrameType | None) -> None:
    """The handler of a sweep: joblib's processes save their runs, and start no other job; a second signal acts at once."""
    if not (workers := multiprocessing.active_children()):
        signals.stop(signum, frame)
    signals.told.append(signum)
    for twice in signals.TWICE:
        signal.signal(twice, signals.stop)
    # joblib composes each job just before it starts, from a list in one of these frames: an empty list starts no other job.
    while frame is not None:
        frame.f_locals.get("job_overrides", []).clear()
        frame = frame.f_back
    if sys.platform != "win32":  # its console has sent them the signal; `kill` would end them before they have saved
        for worker in workers:
            with suppress(ProcessLookupError):
                os.kill(worker.pid, signum)  # type: ignore[arg-type]
