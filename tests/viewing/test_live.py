"""While a run trains, its pictures are drawn between its iterations."""

from __future__ import annotations

import threading
import time
from urllib.request import urlopen

import pytest

from clear_strategies import viewing
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from tests.helpers import saved_run


def test_missing_libraries_are_named(monkeypatch):
    monkeypatch.setattr(viewing, "find_spec", lambda name: None if name == "viser" else object())
    with pytest.raises(SettingError, match=r"the viewer needs viser: pip install 'clear-strategies\[view\]'"):
        viewing.require_viewer()


def test_a_viewer_is_there_while_a_run_trains_and_draws_between_two_iterations_alone(tmp_path, monkeypatch):
    server = pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    viewers, drawn = [], threading.Event()
    opened = server.SplatViewer

    def remembered(*arguments, **options):
        viewers.append(opened(*arguments, **options))
        return viewers[-1]

    monkeypatch.setattr(server, "SplatViewer", remembered)
    saved_run.write(tmp_path)
    splat = open_splat(tmp_path)

    def draw() -> None:  # as nerfview's threads do
        with viewers[0].lock:
            drawn.set()

    with server.watched(splat.painter, splat.poses(), "toy") as after_step:
        after_step(1)
        assert b"<html" in urlopen(viewers[0].address, timeout=20).read()  # noqa: S310 - our own address
        threading.Thread(target=draw).start()
        assert not drawn.wait(0.2)  # an iteration is under way
        monkeypatch.setattr(viewers[0].server, "get_clients", lambda: {0: None})
        monkeypatch.setattr(server, "_TURN", 0.5)
        after_step(2)
        assert drawn.is_set()
        viewers[0].state = "paused"
        threading.Timer(0.3, lambda: setattr(viewers[0], "state", "training")).start()
        began = time.monotonic()
        after_step(3)
        assert time.monotonic() - began > 0.25
    with pytest.raises(OSError, match="refused"):
        urlopen(viewers[0].address, timeout=20)  # noqa: S310
