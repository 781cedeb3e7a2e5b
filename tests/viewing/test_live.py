"""While a run trains, pictures are drawn between its iterations by its own thread."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from urllib.request import urlopen

import pytest

from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from clear_strategies.viewing import live
from clear_strategies.viewing.live import Turns
from tests.helpers import saved_run


@pytest.fixture
def other():
    with ThreadPoolExecutor(1) as thread:
        yield thread


def test_what_another_thread_asks_for_is_done_by_the_training_thread_and_errors_are_raised_where_it_asked(other):
    turns = Turns()
    ident, error = (other.submit(turns.ask, function) for function in (threading.get_ident, lambda: 1 / 0))
    time.sleep(0.05)
    assert not ident.done()
    while not error.done():
        turns.serve()
    assert ident.result() == threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        error.result()


def test_after_training_it_is_done_at_once(other):
    turns = Turns()
    early = other.submit(turns.ask, lambda: "asked while training")
    turns.close()
    assert early.result(5) == "asked while training"
    assert other.submit(turns.ask, threading.get_ident).result(5) == other.submit(threading.get_ident).result()


def test_missing_libraries_are_named(monkeypatch):
    monkeypatch.setattr(live, "find_spec", lambda name: None if name == "viser" else object())
    with pytest.raises(SettingError, match=r"the viewer needs viser: pip install 'clear-strategies\[view\]'"):
        live.require_viewer()


def test_a_viewer_is_there_while_a_run_trains(tmp_path):
    pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    saved_run.write(tmp_path)
    splat, addresses = open_splat(tmp_path), []
    with live.watched(splat.painter, splat.cameras, "toy", addresses.append) as after_step:
        after_step(1)
        assert b"<html" in urlopen(addresses[0], timeout=20).read()  # noqa: S310 - our own address
        after_step(2)
    with pytest.raises(OSError, match="refused"):
        urlopen(addresses[0], timeout=20)  # noqa: S310
