"""`clear-strategies +strategy=clear`: a whole run, or a sweep of runs, by Hydra's command line.

This composes the configuration, checks every setting, prints the plan, trains, and writes its files into Hydra's run folder;
docs/reference/files.md lists them. metrics.json is written last, so a folder that has it holds a finished run.
`clear_strategies.run` is the program: it calls this for whatever is no subcommand, and turns errors into exit codes.
"""

from __future__ import annotations

import gc
import logging
import os
import re
import shlex
import signal
import sys
from argparse import ArgumentParser
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final
from unittest import mock

from hydra import version
from hydra._internal.utils import _run_hydra, get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from clear_strategies import console, files, signals
from clear_strategies.compose import quoted, require_each_once
from clear_strategies.errors import ClearError, SettingError, counted, one_line
from clear_strategies.hydra_errors import NOT_COMPOSED, WRITTEN, not_composed, require_option
from clear_strategies.jobs import exit_codes, sweep
from clear_strategies.options import CONF

_log = logging.getLogger(__name__)
_begun: Final = list[str]()  # the folders of this program's sweeps

FAILED: Final = "failed.txt"
"""In the folder of a sweep's job: why it failed; beside the folder, behind its name, where that holds a finished run."""


@contextmanager
def help_unchecked() -> Iterator[None]:
    """A scope in which argparse does not check the help of each flag that is added, as it does from Python 3.14 on: that of Hydra
    1.3's `--shell-completion` is no string until it is shown.
    """
    with mock.patch.object(ArgumentParser, "_check_help", create=True):
        yield


@help_unchecked()  # throughout: Hydra makes another parser of the line that a shell completes
def main(overrides: Sequence[str] | None = None) -> None:
    """Hydra's command line, and `-v`.

    Args:
        overrides: in place of the program's arguments.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    # Completes settings behind `train PHOTOS`.
    if completed := re.match(r"(\S+ )train \S+ (.*)", os.environ.get("COMP_LINE", "")):
        os.environ["COMP_LINE"] = line = f"{completed[1]}+strategy=best {completed[2]}"
        os.environ["COMP_POINT"] = str(len(line))
    gc.freeze()  # what has been imported stays: collections need not look through torch's objects, which takes 0.1 s
    parser = get_args_parser()
    parser.add_argument("-v", "--verbose", action="store_true", help="Show details, as fit.verbose=true does")
    # Intermixed: Hydra's own call of the parser refuses settings on both sides of a flag.
    options, unknown = parser.parse_known_intermixed_args(sys.argv[1:] if overrides is None else overrides)
    if options.experimental_rerun is not None:  # of `hydra.main`; fit.resume does this
        unknown.append("--experimental-rerun")
    if unknown:  # argparse's message names none of our commands
        raise SettingError(f"{unknown[0].partition('=')[0]}: there is no such flag. {WRITTEN}")
    options.overrides = [*map(readable, options.overrides), *["fit.verbose=true"] * options.verbose]
    for name in ("config_dir", "config_path"):
        folder = getattr(options, name)
        if folder and "://" not in folder:  # Hydra looks for a relative --config-path in this package
            setattr(options, name, str(Path(files.expanded(folder)).absolute()))
    if options.config_dir:
        _require_read(Path(options.config_dir), Path(options.config_path or CONF))
    exit_codes.require("train")
    version.setbase("1.3")
    _begun.clear()
    try:
        _run_hydra(options, parser, job, str(CONF), "config")
    except NOT_COMPOSED as error:
        overrides = [word for word in options.overrides if not word.startswith("hydra.")]
        raise not_composed(error, overrides, "config") from error
    except BrokenProcessPool as error:
        raise sweep.worker_ended(error) from error
    except (KeyboardInterrupt, SystemExit) as end:
        if getattr(end, "code", None) != exit_codes.UNUSABLE:  # the sweep has not come to its end
            for folder in _begun:
                setting = shlex.quote(f"hydra.sweep.dir={folder}")
                _log.info("Go on with the sweep by the same command with %s fit.resume=auto.", setting)
        raise


def _require_read(folder: Path, first: Path) -> None:
    """Raise a SettingError for a file of `--config-dir` that Hydra does not read, since `first` has one of the same name."""
    names = (path.relative_to(first) for path in sorted(first.rglob("*.yaml")))
    if folder.resolve() != first.resolve() and (hidden := next((n for n in names if (folder / n).is_file()), None)):
        raise SettingError(
            f"--config-dir: {folder / hidden} is not read, since {first} has a file of this name. Rename it, or move your "
            "options to a folder of their own; to run a saved configuration, such as RUN/.hydra/config.yaml, give its folder by "
            "--config-path."
        )


def readable(word: str) -> str:
    """A word of the command line, its value quoted where Hydra's grammar has no such value, as paths may have any letters, or
    where it would take a path with a comma for two, or leave out backslashes of one of Windows. A `~` of Hydra's own folders is
    expanded; `compose.tree` does the others.
    """
    key, equals, value = word.partition("=")
    if not equals:
        return word
    if key in ("hydra.run.dir", "hydra.sweep.dir") and not value:  # as of a variable that is not set
        raise SettingError(f"{key}: must be a folder, got nothing: {key}=.")
    if key.lstrip("+").startswith("hydra."):
        value = files.expanded(value)
        word = f"{key}={value}"
    try:
        chosen = OverridesParser.create().parse_override(word)
    except HydraException:  # it has no `~` in a list, either
        each = re.sub(r"(?<=[\[, ])~[^],]*", lambda path: quoted(files.expanded(path[0])), value)
        return f"{key}={each}" if value.startswith("[") and each != value else f"{key}={quoted(value)}"
    require_option(chosen)
    if chosen.key_or_group == "hydra.job.chdir" and chosen.value():
        raise SettingError(
            f"{word}: relative paths are those of the folder where the command was started. Leave it out; hydra.run.dir=FOLDER "
            "is where a run writes."
        )
    is_path = value.startswith("\\\\") or ({",", "\\"} & {*value} and os.path.exists(value))  # noqa: PTH110 - as `is_file`
    return f"{key}={quoted(value)}" if is_path else word


def job(config: DictConfig) -> float | None:
    """One job of Hydra's. Returns what `jobs.job.run` does; in a sweep also None for a job that failed, was stopped, or is left
    to another.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        with sweep.first_signal_ends_job():
            return None if signals.told else _job(config, folder)
    finally:
        with suppress(OSError):
            folder.rmdir()  # where nothing was written


def _job(config: DictConfig, folder: Path) -> float | None:
    overrides = list(HydraConfig.get().overrides.task)
    with console.logged(folder / "run.log") as log:

        def claim() -> None:
            log()
            for note in (folder / FAILED, _beside(folder)):  # of an earlier sweep
                note.unlink(missing_ok=True)
            written = {"config": config, "hydra": HydraConfig.instance().cfg, "overrides": overrides}
            for name, content in written.items():
                files.write_text(folder / ".hydra" / f"{name}.yaml", OmegaConf.to_yaml(content))

        try:
            from clear_strategies.jobs import job

            require_each_once(overrides)
            return job.run(config, folder, overrides, claim)
        except (Exception, KeyboardInterrupt) as error:
            if (ending := exit_codes.describe(error)) is None:
                if not sweep.in_sweep():
                    raise
                _log.exception("a bug, of a strategy or of this program; the other jobs go on.")
                ending = exit_codes.Ending(exit_codes.UNUSABLE, f"{type(error).__name__}: {one_line(error)}")
            _end(error, ending, folder, resumes=config.fit.get("resume") == "auto")
            return None


def _end(error: BaseException, ending: exit_codes.Ending, folder: Path, *, resumes: bool) -> None:
    """Log why a job ended, and exit; a job that fails in a sweep leaves a note instead, and the other jobs continue."""
    code, message = ending
    if sweep.in_sweep() and isinstance(error, signals.Interrupted):
        message = error.in_sweep
    if sweep.in_sweep() and resumes and isinstance(error, files.HeldError):
        _log.warning("left to the other process: %s", message)
        return
    _log.log(logging.INFO if code > exit_codes.SIGNALS else logging.ERROR, "%s", message)  # a stop is no error
    if sweep.in_sweep() and code == exit_codes.UNUSABLE:
        from clear_strategies.jobs import resume

        finished = resume.begun(folder) == "results"  # its folder stays as it is
        note = _beside(folder) if finished else folder / FAILED
        text = f"job {HydraConfig.get().job.num}: {message}\n"
        files.write_text(note, text.encode(errors="backslashreplace").decode())  # a file's name may not be Unicode
        return
    if (signum := code - exit_codes.SIGNALS) > 0:
        if signum not in signals.STOPS:
            signal.raise_signal(signum)  # all is saved: now the launcher's handler may resubmit the job
        if sweep.in_worker():
            signals.told.append(signum)
            return
    sys.exit(code)


def _beside(folder: Path) -> Path:
    """The note of a failed job whose folder holds a finished run."""
    return folder.with_name(f"{folder.name}_{FAILED}")


def _notes(folder: Path) -> dict[Path, int]:
    """The notes of failed jobs in the folder of sweeps, and when each was written, ns."""
    written = dict[Path, int]()
    for note in folder.rglob(f"*{FAILED}"):
        with suppress(FileNotFoundError):  # another sweep in this folder has just begun this job
            written[note] = note.stat().st_mtime_ns
    return written


class SweepCallback(Callback):
    """Runs at the beginning and end of a sweep, in the process that was started; jobs may run in other processes.

    Several sweeps may have one folder: the notes of jobs that failed in an earlier one stay there.
    """

    def __init__(self) -> None:
        self._earlier = dict[Path, int]()

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        if refusal := sweep.leave_out_what_methods_set_aside(config) or sweep.refusal(config):
            _log.error("%s", refusal)  # of an error that a callback raises Hydra makes a warning
            sys.exit(exit_codes.UNUSABLE)
        signals.handle(sweep.stop_workers)
        self._earlier = _notes(Path(config.hydra.sweep.dir))
        sweep.name_by_all_that_is_swept(config)
        _begun.append(config.hydra.sweep.dir)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        if signals.told:
            sys.exit(exit_codes.SIGNALS + signals.told[0])
        folder = Path(config.hydra.sweep.dir)
        _report(folder)
        failed = defaultdict[str, list[int]](list)
        for note, written in _notes(folder).items():
            if self._earlier.get(note) == written:
                continue
            job, message = note.read_text(encoding="utf-8").strip().split(": ", 1)
            failed[message].append(int(job.removeprefix("job ")))
        if failed:
            listed = (f"job {', '.join(map(str, sorted(jobs)))}: {message}" for message, jobs in failed.items())
            _log.error("%s failed: %s", counted(sum(map(len, failed.values())), "job"), " | ".join(listed))
            sys.exit(exit_codes.UNUSABLE)


def _report(folder: Path) -> None:
    """Write the report of the runs that have finished so far."""
    from clear_strategies import report

    try:
        _log.info("%s", report.write(report.collect([folder]), folder))
    except (ClearError, OSError) as error:  # nothing is finished, or a file is damaged or in the way; the jobs are well
        _log.warning("there is no report: %s", error)
