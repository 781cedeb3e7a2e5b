"""report.html: one file that opens in any browser without a network.

The template is page.html.j2; page.js draws the test views and the maps. Every image is embedded once, however many methods
share it.
"""

from __future__ import annotations

import base64
import hashlib
import html
import logging
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from clear_strategies import files
from clear_strategies.data.photo_files import image_size, jpeg, read_image
from clear_strategies.data.strict_json import read_object
from clear_strategies.data.view_names import file_stem
from clear_strategies.errors import DataError
from clear_strategies.outputs.figures import ERROR_MAX, spaced
from clear_strategies.outputs.maps import MAPS
from clear_strategies.report.runs import Run, skips
from clear_strategies.report.table import Columns, Table
from clear_strategies.viewing import page as splat_page

_log = logging.getLogger(__name__)

BUDGET_MB: Final = 20.0
_VIEWS: Final = 4  # test views of a scene, at most
_PHOTOS: Final = {"lr": "LR, enlarged", "prior": "SR prior", "truth": "truth"}
_TOPS: Final = (0.05, 0.1, 0.25, 0.5, 1.0)  # values at which the colours of a map may end
_FOLDER: Final = Path(__file__).resolve().parent


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A scene on the page, or the average over scenes, which has a table only.

    Args:
        runs: method -> run; of several seeds the first.
        chart: an <svg> element.
        skipped: as from `skipped_work`.
    """

    title: str
    table: Table
    runs: Mapping[str, Run] = field(default_factory=dict)
    chart: str = ""
    skipped: Columns = field(default_factory=dict)

    @property
    def columns(self) -> Columns:
        """The table without the column that repeats the title."""
        return {name: cells for name, cells in self.table.columns.items() if name != "scene" or len(set(cells)) > 1}


@dataclass(frozen=True, slots=True)
class Images:
    """Data URIs by a hash of their content. `lossy` embeds photos as JPEG, but never maps."""

    lossy: bool
    uris: dict[str, str] = field(default_factory=dict)

    def add(self, path: Path, *, exact: bool = False) -> str:
        """Embed an image file; returns its key."""
        as_jpeg = self.lossy and not exact
        content = jpeg(read_image(path)) if as_jpeg else files.read_bytes(path)
        key = hashlib.sha256(content).hexdigest()[:12]
        kind = "jpeg" if as_jpeg else "png"
        self.uris.setdefault(key, f"data:image/{kind};base64,{base64.b64encode(content).decode()}")
        return key


def skipped_work(runs: Mapping[str, Run]) -> Columns:
    """The skipped work of each method, the reason, and the seconds saved; empty where nothing was skipped."""
    lines = [(method, line) for method, run in runs.items() for line in skips(run.folder)]
    columns: Columns = {
        "method": [method for method, _ in lines],
        "stage": [line.get("stage", "") for _, line in lines],
        "skipped because": [line["why"] for _, line in lines],
        # A stage that never ran has no measured time to save.
        "seconds saved": ["" if (s := line.get("seconds_saved", "")) == "0.0" else s for _, line in lines],
    }
    return columns if lines else {}


def write_page(path: Path, sections: Sequence[Section], *, budget_mb: float = BUDGET_MB) -> int:
    """Write the page; returns its size in bytes.

    Images are embedded as PNG where they fit into the budget, else as JPEG, else as JPEG of fewer views; at least one view
    per scene is shown.
    """
    splats = [_splats(section, path.parent) for section in sections]
    for lossy, views in ((False, _VIEWS), *((True, n) for n in range(_VIEWS, 0, -1))):
        images = Images(lossy)
        scenes = [_scene(section, images, views) for section in sections]
        limits = _limits(scenes, lossy=lossy, views=views)
        page = _render(sections, scenes, images, limits, splats).encode()
        if len(page) <= budget_mb * 1e6:
            break
    else:
        _log.warning("report.html is larger than %g MB with one view per scene; raise --page-mb.", budget_mb)
    if limits:
        _log.info("report.html: %s", limits)
    files.write_bytes(path, page)
    return len(page)


def _limits(scenes: Sequence[Mapping[str, Any]], *, lossy: bool, views: int) -> str:
    """What the page leaves out to keep to its size limit."""
    limits = ["Photos are JPEGs, so error maps are exact to about 0.01 only."] if lossy else []
    if views < _VIEWS and any(scene["offered"] > views for scene in scenes):
        limits.append(f"Only {views} of the test views fit into --page-mb.")
    return " ".join(limits)


def _scene(section: Section, images: Images, views: int) -> dict[str, Any]:
    """The data of a scene for page.js."""
    offered = _test_views(section)
    names = spaced(offered, views)
    # page.js finds a layer by its number, so that all views have the same layers.
    kinds = [kind for kind in _PHOTOS if all(_photo(section, name, kind) is not None for name in names)]
    shown = [view for name in names if (view := _view(section, name, kinds, images)) is not None]
    return {"name": section.title, "offered": len(offered), "views": shown, "maps": _maps(section, images, views)}


def _test_views(section: Section) -> list[str]:
    """The test views that all runs rendered; only those with photos in views/, if there are any."""
    if not section.runs:
        return []
    rendered = [{file.stem for file in (run.folder / "renders").glob("*.png")} for run in section.runs.values()]
    names = sorted(set.intersection(*rendered))
    with_photos = [name for name in names if _photo(section, name, "lr") is not None]
    if names and not with_photos:
        _log.warning("%s: no run has views/, so the page has no truth to compare renders with.", section.title)
    return with_photos or names


def _photo(section: Section, view: str, kind: str) -> Path | None:
    """LR photo, prior or truth of a view. All runs of a scene have the same, so the first that is found serves."""
    paths = (run.folder / "views" / f"{view}_{kind}.png" for run in section.runs.values())
    return next((path for path in paths if path.is_file()), None)


def _view(section: Section, name: str, kinds: Sequence[str], images: Images) -> dict[str, Any] | None:
    layers = []
    try:
        for kind in kinds:
            if (path := _photo(section, name, kind)) is not None:
                layers.append({"label": _PHOTOS[kind], "kind": kind, "note": "", "image": images.add(path)})
        for method, run in section.runs.items():
            path = run.folder / "renders" / f"{name}.png"
            width, height = image_size(path)
            note = f"{run.views[name]:.2f} dB" if name in run.views else ""
            layers.append({"label": method, "kind": "method", "note": note, "image": images.add(path)})
    except DataError as error:
        _log.warning("%s; this view is not on the page.", error)
        return None
    return {"name": name, "width": width, "height": height, "layers": layers}


def _maps(section: Section, images: Images, views: int) -> list[dict[str, Any]]:
    """Training views with the maps of every method."""
    mapped: dict[str, dict[str, Any]] = {}
    for method, run in section.runs.items():
        folder = run.folder / "maps"
        try:
            means = read_object(folder / "maps.json")["views"] if folder.is_dir() else {}
            for name in spaced(list(means), views):
                of_view = folder / (stem := file_stem(name))
                if name not in mapped:
                    width, height = image_size(of_view / "prior.png")
                    under = [
                        {"label": _PHOTOS[kind], "image": images.add(of_view / f"{kind}.png")}
                        for kind in ("prior", "lr")
                    ]
                    mapped[name] = {"name": stem, "width": width, "height": height, "under": under, "methods": {}}
                maps = {kind: path for kind in MAPS if (path := of_view / f"{kind}.png").is_file()}
                mapped[name]["methods"][method] = {
                    "label": method,
                    "maps": {kind: images.add(path, exact=True) for kind, path in maps.items()},
                    "means": means[name],
                    "peaks": {
                        kind: float(read_image(path)[..., 0].flatten().quantile(0.995)) for kind, path in maps.items()
                    },
                }
        except (DataError, KeyError, TypeError) as error:
            _log.warning("%s: its maps cannot be shown (%s).", run.folder, error)
    # page.js finds a method by its number, so that all views have the same methods.
    methods = [method for method in section.runs if any(method in view["methods"] for view in mapped.values())]
    for view in mapped.values():
        nothing = {method: {"label": method, "maps": {}, "means": {}, "peaks": {}} for method in methods}
        view["methods"] = list((nothing | view["methods"]).values())
    for view in mapped.values():  # one scale for all methods, so that they can be compared
        peaks = {kind: max((m["peaks"].get(kind, 0.0) for m in view["methods"]), default=0.0) for kind in MAPS}
        view["tops"] = {kind: next((top for top in _TOPS if peak <= top), 1.0) for kind, peak in peaks.items()}
    return list(mapped.values())


def _splats(section: Section, folder: Path) -> dict[str, str]:
    """The splat.html of each run that has one, as an address from the report's folder."""
    return {
        method: quote(Path(os.path.relpath(page, folder)).as_posix())
        for method, run in section.runs.items()
        if (page := run.folder / splat_page.FILE).is_file()
    }


def _render(
    sections: Sequence[Section],
    scenes: Sequence[Mapping[str, Any]],
    images: Images,
    limits: str,
    splats: Sequence[Mapping[str, str]],
) -> str:
    from jinja2 import Environment, FileSystemLoader

    environment = Environment(loader=FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.globals["zip"] = zip
    environment.filters |= {"cell": _cell, "code": _code}
    style, script = ((_FOLDER / f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    names = [section.title for section in sections if section.runs]
    return environment.get_template("page.html.j2").render(
        title=f"Report: {', '.join(names) if len(names) < 4 else f'{len(names)} scenes'}",
        sections=sections,
        data={"images": images.uris, "scenes": scenes, "magma": _magma(), "errorMax": ERROR_MAX},
        limits=limits,
        splats=splats,
        style=style,
        script=script,
    )


def _cell(text: str) -> Any:
    """A table cell; what follows ± in a number is small."""
    from markupsafe import Markup

    if re.match(r"[+\-]?\d", text) is None:
        return Markup("<td>{}</td>").format(text)
    number, _, deviation = text.partition(" ± ")
    small = Markup(" <small>± {}</small>").format(deviation) if deviation else ""
    return Markup('<td class="number">{}{}</td>').format(number, small)


def _code(note: str) -> Any:
    """A note with its `code` as HTML."""
    from markupsafe import Markup

    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(note)))  # noqa: S704 - escaped


def _magma() -> list[str]:
    """The colour map of errors and maps, dark to light, as 256 hex colours."""
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    return [to_hex(mpl.colormaps["magma"](i))[1:] for i in range(256)]
