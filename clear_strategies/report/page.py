"""report.html: one file that opens in any browser without a network, to look at what the table's numbers mean.

Tables and curves are there as they are written; the pictures' viewer and the maps' are page.js. Every picture is stored
once, however many methods share it.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from clear_strategies import files
from clear_strategies.data.photo_files import image_size, jpeg, read_image
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError
from clear_strategies.outputs.maps import MAPS
from clear_strategies.outputs.pictures import evenly
from clear_strategies.report import charts
from clear_strategies.report.runs import Run, skips
from clear_strategies.report.table import Columns

_log = logging.getLogger(__name__)

BUDGET_MB: Final = 20.0
_VIEWS: Final = 4  # test views of a scene, at most
_ERROR_MAX: Final = 0.25  # where the colours of an error map end
_TOPS: Final = (0.05, 0.1, 0.25, 0.5, 1.0)  # where those of an evidence map may end
_FOLDER: Final = Path(__file__).resolve().parent


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A scene on the page.

    Args:
        columns, notes: its table. runs, histories: by method, of several seeds the first.
    """

    title: str
    columns: Columns
    notes: Sequence[str]
    runs: Mapping[str, Run]
    histories: Mapping[str, charts.History]


@dataclass(frozen=True, slots=True)
class Pictures:
    """Data URIs by content; `lossy`: photos are JPEGs, maps never are."""

    lossy: bool
    known: dict[str, str] = field(default_factory=dict)

    def add(self, path: Path, *, exact: bool = False) -> str:
        """The key of a picture."""
        as_jpeg = self.lossy and not exact
        content = jpeg(read_image(path)) if as_jpeg else path.read_bytes()
        key = hashlib.sha256(content).hexdigest()[:12]
        kind = "jpeg" if as_jpeg else "png"
        self.known.setdefault(key, f"data:image/{kind};base64,{base64.b64encode(content).decode()}")
        return key

    @property
    def size(self) -> int:
        return sum(map(len, self.known.values()))


def write(path: Path, sections: Sequence[Section], *, budget_mb: float = BUDGET_MB) -> int:
    """Leave the page; returns its size in bytes.

    PNG where everything fits into the budget, else JPEG, else JPEG of fewer views; one view a scene is always shown.
    """
    page = ""
    for lossy, views in ((False, _VIEWS), *((True, n) for n in range(_VIEWS, 0, -1))):
        pictures = Pictures(lossy)
        scenes = [_scene(section, pictures, views) for section in sections]
        said = _said(scenes, lossy=lossy, views=views)
        page = _page(sections, scenes, pictures, said)
        if len(page.encode()) <= budget_mb * 1e6:
            break
    else:
        _log.warning("report.html is larger than %g MB with one view a scene; raise --page-mb.", budget_mb)
    if said:
        _log.info("report.html: %s", said)
    files.write_text(path, page)
    return len(page.encode())


def _said(scenes: Sequence[Mapping[str, Any]], *, lossy: bool, views: int) -> str:
    """What the budget took away."""
    said = "Photos are JPEGs, so error maps are exact to about 0.01 only." if lossy else ""
    if any(scene["offered"] > views for scene in scenes) and views < _VIEWS:
        said += f" Only {views} of the test views fit into --page-mb."
    return said.strip()


def _scene(section: Section, pictures: Pictures, views: int) -> dict[str, Any]:
    """What page.js needs to know about a scene."""
    offered = _test_views(section)
    chosen = evenly(offered, min(views, _VIEWS))
    shown = [view for name in chosen if (view := _view(section, name, pictures)) is not None]
    return {"name": section.title, "offered": len(offered), "views": shown, "maps": _maps(section, pictures, views)}


def _test_views(section: Section) -> list[str]:
    """Test views that every run rendered; those with LR, prior and truth at hand come alone, if there are any."""
    if not section.runs:
        return []
    rendered = [{file.stem for file in (run.folder / "renders").glob("*.png")} for run in section.runs.values()]
    names = sorted(set.intersection(*rendered))
    whole = [name for name in names if _source(section, name, "lr") is not None]
    if names and not whole:
        _log.warning("%s: no run left views/; the page has no truth to compare renders with.", section.title)
    return whole or names


def _source(section: Section, view: str, kind: str) -> Path | None:
    """What a render is judged by; the same for all runs of a scene, so the first that has it."""
    paths = (run.folder / "views" / f"{view}_{kind}.png" for run in section.runs.values())
    return next((path for path in paths if path.is_file()), None)


def _view(section: Section, name: str, pictures: Pictures) -> dict[str, Any] | None:
    layers = []
    try:
        for kind, label in (("lr", "LR, enlarged"), ("prior", "SR prior"), ("truth", "truth")):
            if (path := _source(section, name, kind)) is not None:
                layers.append({"label": label, "kind": kind, "note": "", "image": pictures.add(path)})
        for method, run in section.runs.items():
            path = run.folder / "renders" / f"{name}.png"
            width, height = image_size(path)
            note = f"{run.views[name]:.2f} dB" if name in run.views else ""
            layers.append({"label": method, "kind": "method", "note": note, "image": pictures.add(path)})
    except DataError as error:
        _log.warning("%s; the page leaves this view out.", error)
        return None
    return {"name": name, "width": width, "height": height, "layers": layers}


def _maps(section: Section, pictures: Pictures, views: int) -> list[dict[str, Any]]:
    """Training views with their evidence, by method."""
    found: dict[str, dict[str, Any]] = {}
    for method, run in section.runs.items():
        folder = run.folder / "maps"
        try:
            of_views = read_object(folder / "maps.json")["views"] if folder.is_dir() else {}
            for name in evenly(list(of_views), views):
                own = folder / Path(name).stem
                width, height = image_size(own / "prior.png")
                view = found.setdefault(
                    name, {"name": Path(name).stem, "width": width, "height": height, "methods": []}
                )
                if "under" not in view:
                    view["under"] = [
                        {"label": label, "image": pictures.add(own / f"{kind}.png")}
                        for kind, label in (("prior", "SR prior"), ("lr", "LR, enlarged"))
                    ]
                maps = {kind: own / f"{kind}.png" for kind in MAPS if (own / f"{kind}.png").is_file()}
                view["methods"].append({
                    "label": method,
                    "maps": {kind: pictures.add(path, exact=True) for kind, path in maps.items()},
                    "means": of_views[name],
                    "peaks": {kind: float(read_image(path)[..., 0].flatten().quantile(0.995)) for kind, path in maps.items()},
                })  # fmt: skip
        except (DataError, KeyError, TypeError) as error:
            _log.warning("%s: its maps cannot be shown (%s).", run.folder, error)
    for view in found.values():  # one scale for all methods, so that they can be compared
        peaks = {kind: max((m["peaks"].get(kind, 0.0) for m in view["methods"]), default=0.0) for kind in MAPS}
        view["tops"] = {kind: next((top for top in _TOPS if peak <= top), 1.0) for kind, peak in peaks.items()}
    return list(found.values())


def _page(sections: Sequence[Section], scenes: Sequence[Mapping[str, Any]], pictures: Pictures, said: str) -> str:
    data = {"images": pictures.known, "scenes": scenes, "magma": _magma(), "errorMax": _ERROR_MAX}
    # No text in the data can end the element that holds it.
    content = json.dumps(data, ensure_ascii=False).replace("<", "\\u003c")
    style, script = ((_FOLDER / f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    links = "".join(f'<a href="#scene-{i}">{html.escape(s.title)}</a>' for i, s in enumerate(sections))
    links = f"<nav>{links}</nav>" if len(sections) > 1 else ""
    body = "".join(_section(i, s, scene) for i, (s, scene) in enumerate(zip(sections, scenes, strict=True)))
    said = f"<p>{html.escape(said)}</p>" if said else ""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(_title(sections))}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<header><h1>{html.escape(_title(sections))}</h1>{links}</header>\n<main>\n{body}</main>\n"
        f'<footer>{said}</footer>\n<script type="application/json" id="data">{content}</script>\n'
        f"<script>\n{script}</script>\n</body>\n</html>\n"
    )


def _title(sections: Sequence[Section]) -> str:
    scenes = [section.title for section in sections if section.runs]
    return f"Report: {', '.join(scenes)}" if len(scenes) < 4 else f"Report: {len(scenes)} scenes"


def _section(number: int, section: Section, scene: Mapping[str, Any]) -> str:
    parts = [f'<section id="scene-{number}">\n<h2>{html.escape(section.title)}</h2>', _table(section.columns)]
    parts.append('<ul class="notes">' + "".join(f"<li>{_inline(note)}</li>" for note in section.notes) + "</ul>")
    if scene["views"]:
        parts.append(f'<h3>Test views</h3>\n<div class="viewer" data-scene="{number}"></div>')
    if scene["maps"]:
        parts.append(
            f'<h3>Where the prior was believed, and corrected</h3>\n<div class="maps" data-scene="{number}"></div>'
        )
    if section.runs:
        parts.append("<h3>Curves</h3>" + charts.legend(list(section.histories)) + _charts(section.histories))
        parts.append(_skipped(section.runs))
    return "\n".join((*parts, "</section>\n"))


def _table(columns: Columns) -> str:
    shown = {name: cells for name, cells in columns.items() if name != "scene" or len(set(cells)) > 1}
    head = "".join(f"<th>{html.escape(name)}</th>" for name in shown)
    lines = []
    for cells in zip(*shown.values(), strict=True):
        lines.append("<tr>" + "".join(_cell(text) for text in cells) + "</tr>")
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _cell(text: str) -> str:
    """Of a number, what it varies by recedes."""
    if re.match(r"[+\-]?\d", text) is None:
        return f"<td>{html.escape(text)}</td>"
    number, _, spread = text.partition(" ± ")
    return f'<td class="number">{number}' + (f" <small>± {spread}</small></td>" if spread else "</td>")


def _charts(histories: Mapping[str, charts.History]) -> str:
    step, seconds = "iteration", "training time, s"
    drawn = (
        charts.chart("PSNR of test views, dB", step, histories, x="t", y="psnr_test", dots=True),
        charts.chart("PSNR of test views, dB", seconds, histories, x="seconds", y="psnr_test", dots=True),
        charts.chart(
            "share of Gaussians in conflict (running mean)", step, histories, x="t", y="conflict", smooth=True
        ),
        charts.chart("number of Gaussians", step, histories, x="t", y="n_gaussians"),
    )
    return f'<div class="charts">{"".join(drawn)}</div>'


def _skipped(runs: Mapping[str, Run]) -> str:
    """What each method left out, why, and what that saved."""
    lines = [(method, line) for method, run in runs.items() for line in skips(run.folder)]
    if not lines:
        return ""
    cells: Columns = {
        "method": [method for method, _ in lines],
        "stage": [line.get("stage", "") for _, line in lines],
        "skipped because": [line["why"] for _, line in lines],
        "seconds saved": [_saved(line.get("seconds_saved", "")) for _, line in lines],
    }
    return f"<h3>What was skipped</h3>{_table(cells)}"


def _saved(text: str) -> str:
    """Where a stage never ran its price is not known."""
    return text if text not in ("", "0.0") else ""


def _inline(note: str) -> str:
    """A note's Markdown: code, and nothing else."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(note))


def _magma() -> list[str]:
    """The colour map of errors and evidence, dark to light, as 256 hex colours."""
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    return [to_hex(mpl.colormaps["magma"](i))[1:] for i in range(256)]
