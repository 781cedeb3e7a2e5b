"""`clear-strategies train PHOTOS`: train on photos or a capture, with the configuration of `clear-strategies setting=value …`.

The reader is chosen by the content of the folder. All arguments after the folder are passed to Hydra unchanged.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from importlib import import_module
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Final

from clear_strategies.commands import is_of_hydra, path_of
from clear_strategies.errors import SettingError
from clear_strategies.jobs import exit_codes

# Training uses photos of up to two megapixels, for which an iteration takes about half a second of a core.
_ITERATIONS: Final = 1000
_USAGE: Final = f"""clear-strategies train PHOTOS [setting=value …]

PHOTOS is a folder of photos, or of a capture: COLMAP's sparse/, a transforms.json or a Blender scene.
The command trains +strategy=best on all photos for fit.iterations={_ITERATIONS}. Settings change that:

  clear-strategies train photos/ fit.iterations=3000
  clear-strategies train photos/ data.views.test_every=8          every 8th photo is kept for testing
  clear-strategies train photos/ data.views.max_hr_megapixels=8   sharper, slower, more memory
  clear-strategies train photos/ data.reader.skip_faulty=true     go on without photos that cannot be read
  clear-strategies train photos/ fit.viewer=true -v               look while it trains; every detail on the console

`clear-strategies data=photos --cfg job` prints all settings.
"""
# Beginnings of arguments that choose the strategies, and the number of iterations; each replaces the command's default.
CHOOSE_STRATEGIES: Final = ("+strategy=", "+method=", "experiment=", "+experiment=")
_CONFIG_DIR: Final = ("--config-dir", "-cd")  # Hydra's flag for a folder of options of one's own
_BEFORE_FOLDERS: Final = (*_CONFIG_DIR, "--config-path", "-cp")
_CHOOSE_ITERATIONS: Final = ("fit.iterations=", "experiment=", "+experiment=", "+protocol=", "+scene=")


def main(arguments: list[str]) -> None:
    """Train on the folder that the first argument names."""
    if "--help" in arguments or "-h" in arguments:
        sys.stdout.write(_USAGE)
        return
    settings = overrides(arguments)
    from clear_strategies import hydra_app

    plain = f"data.path={path_of(arguments[0])}"  # shown with the shell's quotes, without those that Hydra needs
    shown = [plain if hydra_app.readable(plain) == word else word for word in settings]
    sys.stdout.write(f"clear-strategies {shlex.join(shown)}\n")
    hydra_app.main(settings)


def overrides(arguments: Sequence[str]) -> list[str]:
    """Translate the command's arguments to Hydra overrides; a SettingError for a wrong argument."""
    if not arguments or (is_of_hydra(arguments[0]) and not Path(arguments[0]).exists()):
        raise SettingError("train needs a folder of photos first: clear-strategies train PHOTOS [setting=value …].")
    path, rest = path_of(arguments[0]), arguments[1:]
    if "://" in arguments[0]:
        raise SettingError(
            f"train: {arguments[0]} is an address. Download what is there, and name the folder of the photos."
        )
    named = [arguments[0], *takewhile(lambda word: "=" not in word and not is_of_hydra(word), rest)]
    if len(named) > 1 and path_of(whole := " ".join(named)).exists():
        raise SettingError(
            f"train: {whole} has spaces, so it must be quoted: clear-strategies train {shlex.quote(whole)}."
        )
    if not path.exists():
        raise SettingError(f"train: {path} is not there. Name the folder of the photos or of the capture.")
    # The value of a flag, as of --config-dir, is no folder of photos.
    free = [word for before, word in pairwise(arguments) if before not in _BEFORE_FOLDERS]
    if others := [word for word in free if "=" not in word and path_of(word).is_dir()]:
        raise SettingError(
            f"train: {others[0]} is a second folder. Put all photos of the scene into one folder, and give that."
        )
    exit_codes.require("train")
    from clear_strategies.compose import quoted
    from clear_strategies.jobs.resume import begun

    kind = detect(path, *_folders_of_options(rest))
    if kind == "photos" and begun(path):
        remedy = f"view {shlex.quote(str(path))} shows it; the command that began it, with fit.resume={path}, goes on"
        raise SettingError(f"train: {path} is the folder of a run, not of photos. clear-strategies {remedy}.")
    defaults = {"+strategy=best": CHOOSE_STRATEGIES, f"fit.iterations={_ITERATIONS}": _CHOOSE_ITERATIONS}
    used = [default for default, chosen in defaults.items() if not any(word.startswith(chosen) for word in rest)]
    return [*used, f"data={kind}", f"data.path={quoted(str(path))}", *rest]


def _folders_of_options(arguments: Sequence[str]) -> list[Path]:
    """The folder that `--config-dir` names, if it is there; of several Hydra takes the last."""
    words = [f"{before}={word}" if before in _CONFIG_DIR else word for before, word in pairwise(["", *arguments])]
    named = [folder for flag, _, folder in (word.partition("=") for word in words) if flag in _CONFIG_DIR and folder]
    return [folder for folder in map(path_of, named[-1:]) if folder.is_dir()]


def detect(path: Path, *own: Path) -> str:
    """Choose the option of the group `data` for a path, by the highest rank of the readers: the value of `recognises` in the
    reader's module, 0 if it cannot read the path. A folder may contain several formats, as LLFF's contain a COLMAP model.

    Args:
        own: folders of options besides conf/ and those of other packages.
    """
    from clear_strategies.options import options
    from clear_strategies.settings import TARGET, located

    ranks = {}
    for name, node in options("data", *own).items():
        if target := (node.get("reader") or {}).get(TARGET):
            located(target, f"data={name}: reader")
            module = import_module(target.rpartition(".")[0])
            ranks[name] = module.recognises(path) if hasattr(module, "recognises") else 0
    return max(sorted(ranks), key=lambda name: ranks[name])
