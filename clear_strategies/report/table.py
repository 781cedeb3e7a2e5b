"""The table of runs: one row per method, with its difference from a reference: the baseline, unless another is chosen.

Differences are taken seed by seed if two methods share seeds, so that the effect of a seed on both methods is not part of the
error.
"""

from __future__ import annotations

import html
import logging
import math
from collections.abc import Sequence
from typing import Final

import pandas as pd

from clear_strategies.errors import SettingError
from clear_strategies.outputs.metrics import NOTE
from clear_strategies.report.runs import OWN, FinishedRun

_log = logging.getLogger(__name__)

# Quantity -> header of its column, and the format of its numbers.
_QUANTITIES: Final = {
    "psnr": ("PSNR (dB) ↑", ".2f"), "ssim": ("SSIM ↑", ".4f"), "gmsd": ("GMSD ↓", ".4f"), "blur": ("blur → 0", "+.4f"),
    "bicubic": ("bicubic (dB)", ".2f"), "prior": ("prior (dB)", ".2f"), "conflict": ("conflict", ".3f"),
    "gaussians": ("Gaussians", ",.0f"), "seconds": ("seconds", ",.0f"),
}  # fmt: skip
_PAIRS: Final = 2  # the least number of pairs for which a difference has an error
_UNPAIRED: Final = "*"
_BASELINE: Final = "baseline"


def compare(runs: Sequence[FinishedRun], against: str | None = None) -> pd.DataFrame:
    """Summarize the runs: for each scene, in the order of the runs, one row per method; then the averages over scenes.

    Args:
        against: the reference, by the name of its row or its run; None, or in a scene that lacks it: the baseline, or without
            one the first method. Of several with this name, a method is compared with the one of its own settings.

    Returns:
        The columns scene; method: its name, then the settings that not all runs of the scene share; average: True for an average;
        run: the first of a method; runs: their number; seeds. The mean of each quantity, and its standard deviation over the
        seeds of a method, `_std`. For PSNR also that of the best seed, `_best`, and the difference from the scene's reference,
        `_delta`, its standard error, `_delta_error`, and the number of its pairs, `_delta_pairs`: runs of the same seed, in an
        average of the same scene and seed. reference: True for the row of the reference.

    Raises:
        SettingError: no run is of the method `against`.
    """
    single = _each_seed_once(run_rows(runs))
    names = dict.fromkeys((*(run.name for run in single["run"]), *single["method"]))
    if against is not None and against not in names:
        raise SettingError(f"--against: must be a method of the runs, got {against}. There are {'; '.join(names)}.")
    tables = [_summary(rows, against) for _, rows in single.groupby("scene", sort=False)]
    # Scores against LR photos, or of training views, are not averaged with others.
    for marks, alike in single.groupby("marks", sort=False):
        count = alike["scene"].nunique()
        title = f"average of {count} scenes" + (f" ({marks})" if marks else "")
        if count > 1 and len(comparable := _of_all_scenes(alike, title)):
            tables.append(_average(comparable, title, against))
    return pd.concat(tables, ignore_index=True).astype({"psnr_delta_pairs": "Int64"})


def layout(table: pd.DataFrame) -> pd.DataFrame:
    """Format the rows of `compare` as text, without empty columns."""
    cells: dict[str, Sequence[str]] = {"scene": list(table["scene"]), "method": list(table["method"])}
    for quantity, (header, form) in _quantities(table).items():
        cells[header] = _numbers(table[quantity], table[f"{quantity}_std"], form)
        if quantity == "psnr":
            delta = _numbers(table["psnr_delta"], table["psnr_delta_error"], "+.2f")
            rows = zip(delta, _unpaired(table), table["reference"], strict=True)
            marked = ["reference" if it else cell + _UNPAIRED * int(few) for cell, few, it in rows]
            cells["Δ"] = marked if _differ(table) else [""] * len(table)
            cells["best"] = _numbers(table["psnr_best"], None, form)
    cells["seed"] = list(table["seeds"])
    return pd.DataFrame({name: column for name, column in cells.items() if any(column)})


def _quantities(table: pd.DataFrame) -> dict[str, tuple[str, str]]:
    """`_QUANTITIES`, and the runs' own metrics."""
    own = [name for name in map(str, table) if name.startswith(OWN) and not name.endswith("_std")]
    return {**_QUANTITIES, **{name: (name, ".4f") for name in own}}


def notes(table: pd.DataFrame, runs: Sequence[FinishedRun]) -> list[str]:
    """Notes for readers of the table."""
    lines = [f"For comparison, {NOTE}."]
    if _differ(table):
        error = "; its ±: standard error of the differences seed by seed" * int(table["psnr_delta_error"].notna().any())
        references = " or ".join(f"`{method}`" for method in dict.fromkeys(table.loc[table["reference"], "method"]))
        lines.append(f"Δ: PSNR over the reference, {references}, dB{error}.")
        if _unpaired(table).any():
            why = "fewer than two seeds are common to both methods"
            lines.append(f"Δ{_UNPAIRED}: {why}, so this is the difference of their means, without an error.")
    if table["psnr_best"].notna().any():
        lines.append("±: standard deviation over seeds; best: PSNR of the best seed.")
    if table["average"].any():
        lines.append("Averages are means of the scenes' means; their Δ is paired over scenes and seeds.")
    for scene, of_scene in _by_scene(runs).items():
        if scene in set(table["scene"]) and (shared := _in_all([run.settings for run in of_scene])):
            lines.append(f"All runs of {scene}: `{' '.join(shared)}`.")
    return lines


def _differ(table: pd.DataFrame) -> bool:
    return bool((table["psnr_delta"].abs() > 0).any())


def _unpaired(table: pd.DataFrame) -> pd.Series[bool]:
    """The mask of rows, other than references, whose Δ has too few pairs for an error."""
    return ~table["reference"] & table["psnr_delta"].notna() & (table["psnr_delta_pairs"] < _PAIRS)


def markdown(cells: pd.DataFrame, lines: Sequence[str]) -> str:
    """Format a Markdown table whose columns also align in a terminal, with the notes below it."""
    columns = [[_plain(cell) for cell in (name, *cells[name])] for name in cells]
    widths = [max(map(len, column)) for column in columns]
    head, *rows = (
        "| " + " | ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) + " |"
        for row in zip(*columns, strict=True)
    )
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return "\n".join((head, rule, *rows, "", *(html.escape(line, quote=False) for line in lines), ""))


def _plain(cell: str) -> str:
    """Escape a cell for Markdown, which may contain HTML: names of scenes and methods come from files."""
    return html.escape(" ".join(cell.split()), quote=False).replace("|", "\\|")


def _numbers(means: pd.Series[float], deviations: pd.Series[float] | None, form: str) -> list[str]:
    """Format means, with ± for the deviations that are known; empty for a mean that is not."""
    small = [math.nan] * len(means) if deviations is None else list(deviations)
    return [
        "" if math.isnan(mean) else f"{mean:{form}}" + ("" if math.isnan(s) else f" ± {s:{form.lstrip('+')}}")
        for mean, s in zip(means, small, strict=True)
    ]


def _by_scene(runs: Sequence[FinishedRun]) -> dict[str, list[FinishedRun]]:
    return {scene: [run for run in runs if run.scene == scene] for scene in dict.fromkeys(run.scene for run in runs)}


def run_rows(runs: Sequence[FinishedRun]) -> pd.DataFrame:
    """A row for each run, scene by scene: the run, its scene, marks, label, method, seed and numbers. The method is the run's
    name and the label, which has the settings that not all runs of the scene share.

    `key` is name and settings, a line each; `identity`, the key of an average, leaves out the `data` settings that all runs of
    the scene share, which describe the scene.
    """
    rows = []
    for of_scene in _by_scene(runs).values():
        shared = _in_all([run.settings for run in of_scene])
        for run in of_scene:
            of_all = [s for s in run.settings if s not in shared or not s.lstrip("+~").startswith("data")]
            key, identity = ("\n".join((run.name, *sorted(settings))) for settings in (run.settings, of_all))
            label = _label("", run.settings, shared)
            names = {"scene": run.scene, "marks": run.marks, "label": label, "method": run.name + label}
            rows.append({**names, "seed": run.seed, "key": key, "identity": identity, "run": run, **run.numbers})
    return pd.DataFrame(rows)


def _each_seed_once(single: pd.DataFrame) -> pd.DataFrame:
    """Keep the last of several runs of one method and seed: a mean that counts a seed twice has a wrong error."""
    again = single.duplicated(["scene", "key", "seed"], keep="last")
    for scene, method, seed, run in single.loc[again, ["scene", "method", "seed", "run"]].itertuples(index=False):
        _log.warning("%s, %s: another run has seed %s, too; %s is left out.", scene, method, seed, run.folder)
    return single[~again]


def _summary(single: pd.DataFrame, against: str | None) -> pd.DataFrame:
    """A row for each method of one scene."""
    groups = single.groupby("key", sort=False)
    table = groups[["scene", "method", "run"]].first().assign(average=False, runs=groups.size())
    for row in table[groups["psnr"].count() < table["runs"]].itertuples():
        _log.warning("%s, %s: runs without a finite PSNR are left out of its mean.", row.scene, row.method)
    table["seeds"] = groups["seed"].agg(lambda seeds: ", ".join(map(str, sorted(set(seeds)))))
    for quantity in _quantities(single):
        table[quantity], table[f"{quantity}_std"] = groups[quantity].mean(), groups[quantity].std()
    table["psnr_best"] = groups["psnr"].max().where(groups["psnr"].count() > 1)
    return table.join(_differences(single, "key", table["psnr"], against)).reset_index(drop=True)


def _of_all_scenes(single: pd.DataFrame, title: str) -> pd.DataFrame:
    """Keep the runs of methods that all scenes have."""
    scenes = single.groupby("identity", sort=False)["scene"].nunique()
    complete = single["identity"].map(scenes == single["scene"].nunique())
    if left_out := list(dict.fromkeys(single.loc[~complete, "method"])):
        _log.info("%s: left out, because not all scenes have it: %s.", title, "; ".join(left_out))
    return single[complete]


def _average(single: pd.DataFrame, title: str, against: str | None) -> pd.DataFrame:
    """A row for each method, averaged over the scenes, all of which have it."""
    scenes = single["scene"].nunique()
    means = (
        single.groupby(["identity", "scene"], sort=False)[[*_quantities(single)]].mean().groupby("identity", sort=False)
    )
    # A quantity that one scene lacks has no average.
    table = means.mean().where(means.count() == scenes).assign(average=True, runs=0, seeds="", scene=title)
    shared = _in_all([identity.split("\n")[1:] for identity in table.index])
    table["method"] = [_label(name, settings, shared) for name, *settings in table.index.str.split("\n")]
    return table.join(_differences(single, "identity", table["psnr"], against)).reset_index(drop=True)


def _differences(single: pd.DataFrame, key: str, means: pd.Series[float], against: str | None) -> pd.DataFrame:
    """PSNR of each method minus that of its reference: over the pairs of one scene and seed, or, with fewer than two pairs, the
    difference of the two means, without an error.
    """
    # A method whose PSNR is never finite must have a column as well. Unsorted, pandas 2 unstacks into wrong columns.
    by_seed = single.groupby([key, "scene", "seed"], sort=False)["psnr"].mean().unstack(key)
    references = [*map(_references(single, key, against).get, by_seed)]
    pairs = by_seed - by_seed[references].to_numpy()
    table = pd.DataFrame(
        {"psnr_delta": pairs.mean(), "psnr_delta_error": pairs.sem(), "psnr_delta_pairs": pairs.count()}
    ).assign(reference=by_seed.columns == references)
    of_means = means[by_seed.columns] - means[references].to_numpy()
    table["psnr_delta"] = table["psnr_delta"].where(table["psnr_delta_pairs"] >= _PAIRS, of_means)
    table.loc[table["reference"], ["psnr_delta", "psnr_delta_error"]] = 0.0, math.nan
    return table


def _references(single: pd.DataFrame, key: str, against: str | None) -> dict[str, str]:
    """The key of the reference of each method: the one called `against`, else the baseline, else the first; of several that
    differ in their settings, the one that has the most of the method's, and no others.
    """
    rows = zip(single[key], single["method"], (run.name for run in single["run"]), strict=True)
    first, label, name = max(rows, key=lambda row: (row[1] == against, row[2] == against, row[2] == _BASELINE))
    settings = {method: {word.lstrip("+") for word in method.split("\n")[1:]} for method in single[key]}
    if label == against != name:
        return dict.fromkeys(settings, first)
    references = [method for method in settings if method.partition("\n")[0] == name]

    def nearest(method: str) -> str:
        possible = [its for its in references if settings[its] <= settings[method]]
        best: str = max(possible, key=lambda its: len(settings[its]), default=first)
        return best

    chosen = {method: nearest(method) for method in settings if method not in references}
    return {method: chosen.get(method, method if method in chosen.values() else first) for method in settings}


def _in_all(lists: Sequence[Sequence[str]]) -> list[str]:
    """The items that all lists have in common, in the order of the first."""
    return [setting for setting in lists[0] if all(setting in other for other in lists)] if lists else []


def _label(name: str, settings: Sequence[str], shared: Sequence[str]) -> str:
    """The name of a row: the method's, and the settings that not all of the runs share."""
    return ", ".join((name, *(s for s in settings if s not in shared)))
