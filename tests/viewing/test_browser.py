"""The viewer in a real browser shows something, and a drag turns it."""

from __future__ import annotations

import base64
import io
import shutil
import time

import numpy as np
import pytest
from PIL import Image

from clear_strategies.jobs.saved import open_splat
from tests.helpers import saved_run

sync_api = pytest.importorskip("playwright.sync_api", reason="apt install chromium && pip install playwright")
server = pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE = 120  # seconds; WebGL in software on a busy machine is slow
LEFT = (20, 200, 200, 400)  # of the page: neither its panel nor its message covers this part

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="apt install chromium && pip install playwright"),
]


def picture(session) -> np.ndarray:
    shot = session.send("Page.captureScreenshot", {"format": "png"})
    with Image.open(io.BytesIO(base64.b64decode(shot["data"]))) as image:
        return np.asarray(image.convert("RGB").crop(LEFT), int)


def until(what, found):
    ends = time.monotonic() + PATIENCE
    while time.monotonic() < ends:
        if found(seen := what()):
            return seen
        time.sleep(0.5)
    raise AssertionError("the page did not change in time")


def require_that_a_drag_turns_it(page) -> None:
    """The page shows something, and something else after the drag."""
    session = page.context.new_cdp_session(page)
    before = until(lambda: picture(session), lambda shown: shown.std() > 8)  # an empty page has one colour

    def after_a_drag() -> np.ndarray:
        page.mouse.move(100, 300)
        page.mouse.down()
        page.mouse.move(180, 320, steps=4)
        page.mouse.up()
        return picture(session)

    # A page that has drawn may not listen yet, so the drag is repeated; a page of points is mostly white.
    until(after_a_drag, lambda shown: np.abs(shown - before).mean() > 1)


def test_the_viewer_shows_the_splat_and_a_drag_turns_it(tmp_path):
    saved_run.write(tmp_path)
    splat = open_splat(tmp_path)
    viewer = server.SplatViewer(splat.painter, [], title="toy", port=8421, out=tmp_path)
    try:
        with sync_api.sync_playwright() as playwright:
            page = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE).new_page(
                viewport={"width": 640, "height": 420}
            )
            page.set_default_timeout(1000 * PATIENCE)
            page.goto(viewer.address)
            require_that_a_drag_turns_it(page)
    finally:
        viewer.close()
