"""The viewer and a report in a real browser, without a window: what is seen, what a click does, and what is asked of whom."""

import io
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import rasterizers
from clear_strategies import report
from clear_strategies.core.images import to_bytes
from clear_strategies.viewing.look import Painter, colored, depth_range
from rasterizers.interface import Camera
from tests.helpers import wall
from tests.helpers.finished_run import make_run

pytestmark = pytest.mark.slow
SIZE = (1000, 600)  # of the page
_CLOSE = 5.0  # levels of 255: JPEG, and a picture that the browser resizes


class Page:
    """A page of Chromium that notes errors, and every address that it asks."""

    def __init__(self, browser: Any) -> None:
        self.page = browser.new_page(viewport=dict(zip(("width", "height"), SIZE, strict=True)))
        self.page.set_default_timeout(60_000)
        self.errors, self.asked = list[str](), list[str]()
        self.page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda socket: self.asked.append(socket.url))

    def require_own(self, *own: str) -> None:
        """No error, and no request to anyone but the server that is looked at."""
        assert not self.errors
        assert self.asked
        assert not [url for url in self.asked if not url.startswith(own)]

    def canvas(self) -> np.ndarray:
        with Image.open(io.BytesIO(self.page.locator("canvas").first.screenshot())) as shot:
            return np.asarray(shot.convert("RGB"))

    def wait_for(self, expected: Callable[[int, int], np.ndarray]) -> float:
        """Wait until the canvas shows `expected(width, height)` where nothing lies over it; returns the mean difference."""
        for _ in range(120):
            shown = self.canvas()
            h, w, _ = shown.shape
            part = slice(h // 3, 9 * h // 10), slice(w // 4, 9 * w // 10)  # no message, axes or panel
            apart = float(np.abs(shown[part].astype(float) - expected(w, h)[part]).mean())
            if apart < _CLOSE:
                return apart
            self.page.wait_for_timeout(250)
        raise AssertionError(f"the canvas is {apart:.1f} levels from what is expected")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    with api.sync_playwright() as playwright:
        own = playwright.chromium.executable_path  # of `playwright install chromium`
        found = shutil.which("chromium") or shutil.which("google-chrome") or (own if Path(own).is_file() else None)
        if found is None:
            pytest.skip("needs a browser: apt install chromium, or playwright install --with-deps chromium")
        chromium = playwright.chromium.launch(
            executable_path=found, args=["--no-sandbox", "--enable-unsafe-swiftshader"]
        )
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Any) -> Iterator[Page]:
    opened = Page(browser)
    yield opened
    opened.page.close()


def seen_whole(camera: Camera, width: int, height: int) -> Camera:
    """The camera with a page's size, at which its whole photo is seen."""
    focal = min(width * camera.fx / camera.width, height * camera.fy / camera.height)
    return replace(camera, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)


def test_the_viewer_shows_what_render_draws_its_depth_and_a_jump_to_another_camera_with_its_photo(page):
    server = pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    name = "cpp" if "cpp" in rasterizers.available() else "torch"
    painter = Painter(wall.painter().field, lambda **settings: rasterizers.load(name, **settings))
    first, to_the_side = wall.at(-0.8), wall.at(0.6)
    painter.field.sh0.data.copy_(torch.randn(painter.field.sh0.shape, generator=torch.Generator().manual_seed(0)))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.from_numpy(Rotation.from_euler("yx", (0.35, -0.1)).as_matrix())
    turned = replace(to_the_side, world_to_camera=turn @ to_the_side.world_to_camera.double())
    viewer = server.SplatViewer(
        painter, {"first.png": first, "turned.png": turned}, title="toy", port=8330,
        photo=lambda name: to_bytes(painter.color(turned)) if name == "turned.png" else None,
    )  # fmt: skip

    def color(camera: Camera) -> Callable[[int, int], np.ndarray]:
        return lambda w, h: to_bytes(painter.color(seen_whole(camera, w, h)))

    def depth(w: int, h: int) -> np.ndarray:
        drawn = painter.depth(seen_whole(turned, w, h))
        return colored(drawn, *depth_range(drawn))

    try:
        page.page.goto(viewer.address)
        by_height = replace(first, fx=first.fy, width=2, height=first.height)  # at first the page's width is unknown
        page.wait_for(color(by_height))
        page.page.get_by_text("Drawn: the colour of").wait_for()
        page.page.get_by_role("combobox", name="Camera").click()
        page.page.get_by_role("option", name="turned.png").click()
        page.wait_for(color(turned))
        assert np.abs(color(turned)(300, 200).astype(float) - color(first)(300, 200)).mean() > 2 * _CLOSE
        photo = page.page.get_by_role("img").and_(page.page.locator("[src^=blob]"))
        photo.wait_for()
        assert photo.evaluate("image => [image.naturalWidth, image.naturalHeight]") == [
            5 * turned.width,
            5 * turned.height,
        ]
        page.page.get_by_label("Depth", exact=True).check()
        page.wait_for(depth)
        page.page.get_by_text("Drawn: depth, bright at").wait_for()
        page.page.get_by_role("button", name="Look from it again").click()
        page.require_own(viewer.address, f"blob:{viewer.address}", viewer.address.replace("http", "ws"), "data:")
    finally:
        viewer.close()


def test_a_report_opens_from_the_disk_with_its_pictures_and_asks_nobody(tmp_path: Path, page: Page) -> None:
    for strategy, psnr in (("gco", 20.0), ("clear", 21.0)):
        make_run(tmp_path / strategy, f"+strategy={strategy}", psnr=psnr)
    report.write(report.collect([tmp_path]), tmp_path)
    page.page.goto((tmp_path / "report.html").as_uri())
    assert page.page.get_by_role("cell", name="21.00").first.is_visible()
    pictures = page.page.locator("img").evaluate_all("all => all.map(image => image.naturalWidth)")
    assert pictures
    assert all(width > 100 for width in pictures)
    assert "`" not in page.page.locator("body").inner_text()
    page.require_own(tmp_path.as_uri())
