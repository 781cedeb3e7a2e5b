"""The options of conf/ and of other packages, as Hydra reads and composes them.

Each node with a `_target_` is filled with the defaults of what it names. To import this file registers conf/ and its resolvers.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import hydra
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from clear_strategies.errors import SettingError, one_line
from clear_strategies.settings import CHANGES_NO_RESULT, TARGET, defaults_of, flat, key_of, with_defaults

_PACKAGE: Final = Path(__file__).resolve().parent
# In a wheel conf/ lies inside the package, in a checkout beside it.
CONF: Final = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"

OPTIONS: Final = "clear_strategies_conf"
"""The group of entry points by which other packages bring options, such as strategies; docs/template is such a package."""

READINGS: Final = "readings"
"""The key of a configuration for what `readings=` says of each strategy."""
UNNAMED: Final = CHANGES_NO_RESULT | {"experiment", "data.root", "prior.path"}
"""What the name of a job's folder leaves out: what changes no result, so that `-v` or fit.viewer=true trains nothing again, and
where data and SR images lie, which may move: for pictures of another SR model give another hydra.sweep.dir.
"""
# Bytes of a folder's name: most file systems take 255, and Windows 260 of a whole path.
_LONGEST_NAME: Final = 80 if sys.platform == "win32" else 200
_NOT_IN_NAMES: Final = re.compile(r'[<>:"\\|?*\x00-\x1f]|[. ]\Z')  # of Windows


def composed_by_hydra(overrides: Sequence[str], config: str) -> DictConfig:
    """conf/ with these overrides, from its file `config`; the errors are Hydra's and OmegaConf's."""
    # The caller may be a Hydra application, whose state is restored afterwards.
    shared = GlobalHydra.instance()
    before, shared.hydra = shared.hydra, None
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return hydra.compose(config, list(overrides))
    finally:
        GlobalHydra.instance().hydra = before


def strategies_of(option: str) -> list[str]:
    """The strategies that an option of conf/strategy consists of, those of the options that it names included."""
    _, parts, _ = _read_option("strategy", option)
    return [strategy for part in parts for strategy in strategies_of(part)] or [option]


def sweeps(experiment: str) -> bool:
    """Return True if an option of conf/experiment, or one that it consists of, names settings that are swept."""
    content, parts, _ = _read_option("experiment", experiment)
    return bool("sweeper" in content.get("hydra", {})) or any(map(sweeps, parts))


def _read_option(group: str, option: str) -> tuple[dict[str, Any], list[str], bool]:
    """The content of an option's file, empty if there is none; the options of the same group in its defaults list; and whether
    it has whole keys.
    """
    file = next((file for folder in _folders() if (file := folder / group / f"{option}.yaml").is_file()), None)
    text = file.read_text(encoding="utf-8") if file else "{}"
    content: Any = OmegaConf.to_container(OmegaConf.create(text))
    parts = [part for part in content.get("defaults", []) if isinstance(part, str)]
    own = [part for part in parts if part != "_self_" and not part.startswith("/")]
    return content, own, text.startswith("# @package _global_")


def has_setting(group: str, option: str, key: str) -> bool:
    """Return True if an option, or one of its group that it consists of, has a setting, as data=colmap has data.path."""
    content, parts, is_global = _read_option(group, option)
    own = flat(with_defaults(content), "" if is_global else f"{group}.")
    return key in own or any(has_setting(group, part, key) for part in parts)


def _folders() -> Iterator[Path]:
    """conf/, and then the folders that other packages bring, which takes 25 ms to find."""
    yield CONF
    yield from (Path(_folder_of(point)) for point in entry_points(group=OPTIONS))


def options(group: str, *own: Path) -> dict[str, Mapping[str, Any]]:
    """The content of each file in a group, by its name.

    Args:
        own: further folders, as of Hydra's `--config-dir`.
    """
    files = [file for folder in (*_folders(), *own) for file in sorted((folder / group).glob("[!_]*.yaml"))]
    return {file.stem: _content(file) for file in files}


def _content(file: Path) -> dict[str, Any]:
    """The settings of a file; a SettingError where it holds none."""
    try:
        content: Any = OmegaConf.to_container(OmegaConf.load(file))
    except YAMLError as error:
        raise malformed(error) from error
    if not isinstance(content, dict):
        raise SettingError(f"{file}: a file of options has lines as `name: value`, got {content!r}. Correct it.")
    return content


def malformed(error: YAMLError) -> SettingError:
    """The error for a file of options that is no YAML; PyYAML's message names the file and the line."""
    return SettingError(f"a file of options is no valid YAML: {one_line(error)}. Correct that line.")


class _ConfSource(FileConfigSource):
    """The files of conf/, each node with a `_target_` filled with the defaults of what it names."""

    @staticmethod
    def scheme() -> str:
        return "clear"

    def load_config(self, config_path: str) -> ConfigResult:
        file = Path(self.path, self._normalize_file_name(config_path))
        read = _read(self.provider, self.path, config_path, file.stat().st_mtime_ns if file.is_file() else 0)
        return replace(
            read, config=OmegaConf.create(with_defaults(OmegaConf.to_container(read.config))), header={**read.header}
        )


@cache  # for one command Hydra reads each file twice, and once more for each job of a sweep
def _read(provider: str, folder: str, config_path: str, written: int) -> ConfigResult:
    """What Hydra reads of a file that was written at this time, ns."""
    return FileConfigSource(provider, folder).load_config(config_path)


class _ReadConf(SearchPathPlugin):
    """Makes Hydra read conf/, and after it the folders that other packages bring, by `_ConfSource`."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        conf = [e for e in search_path.get_path() if e.path is not None and e.path.removeprefix("file://") == str(CONF)]
        for element in conf:
            element.path = f"{_ConfSource.scheme()}://{CONF}"
        for point in entry_points(group=OPTIONS) if conf else ():
            search_path.append(point.name, f"{_ConfSource.scheme()}://{_folder_of(point)}")


def _folder_of(point: EntryPoint) -> str:
    """The folder of the package that an entry point of `OPTIONS` names; a SettingError where there is none."""
    try:
        spec = find_spec(point.value)
    except ModuleNotFoundError:  # the package that it lies in
        spec = None
    if spec is None or not spec.submodule_search_locations:
        raise SettingError(
            f"the entry point {point.name} = {point.value!r} of {OPTIONS!r} must name a package, and there is none of this "
            f"name. Mend or remove the package that brings it: pip show -f {point.dist.name if point.dist else point.name}."
        )
    return str(next(iter(spec.submodule_search_locations)))


def _job_folder(*swept: str, _root_: Any) -> str:
    """`${job_folder:}` in conf/: the name of a job's folder in a sweep, its overrides.

    Args:
        swept: keys of `UNNAMED` in which the jobs of this sweep differ, and which are in it all the same.
    """
    words, left_out = list[str](), {*UNNAMED}.difference(swept)
    for word in _root_.hydra.overrides.task:
        key = key_of(word)
        if key == "method" and _root_.get("method") is not None:  # it sets the strategies before it aside
            words = [before for before in words if key_of(before) != "strategy"]
        if key not in left_out:
            words.append(word)
    return _one_folder(",".join(sorted(words)) or "defaults")


def _one_folder(name: str) -> str:
    """The name as one word that every file system takes. A path in it would otherwise lead elsewhere: behind `../..` all jobs
    share a folder.
    """
    word = name.replace("/", "_")
    if len(word.encode()) <= _LONGEST_NAME and not _NOT_IN_NAMES.search(word):
        return word
    word = _NOT_IN_NAMES.sub("_", word)
    digest = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{word.encode()[: _LONGEST_NAME - len(digest) - 1].decode(errors='ignore')}_{digest}"


def _reading(*, _node_: Any, _root_: Any) -> Any:
    """`${reading:}` in conf/strategy: what readings= says of this setting, else the default of the class.

    So readings of strategies that take no part have no effect, whatever the order of the options.
    """
    _, strategy, *field = _node_._get_full_key(None).split(".")
    read = OmegaConf.select(_root_, ".".join((READINGS, strategy, *field)))
    return defaults_of(_root_.strategies[strategy][TARGET], *field) if read is None else read


OmegaConf.register_new_resolver("job_folder", _job_folder, replace=True)
OmegaConf.register_new_resolver("reading", _reading, replace=True)
Plugins.instance().register(_ConfSource)
Plugins.instance().register(_ReadConf)
