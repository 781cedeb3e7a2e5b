"""While a run trains, pictures are drawn between its iterations by its own thread."""

from __future__ import annotations

import threading
from http.client import HTTPConnection

import pytest

from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from clear_strategies.viewing import live
from clear_strategies.viewing.live import Turns
from tests.helpers import saved_run


def asked(turns: Turns, function) -> tuple[threading.Thread, list]:
    answers: list = []

    def ask() -> None:
        try:
            answers.append(turns.ask(function))
        except ValueError as error:
            answers.append(error)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    return thread, answers


def test_what_another_thread_asks_for_is_done_by_the_training_thread():
    turns = Turns()
    thread, answers = asked(turns, threading.get_ident)
    thread.join(0.05)
    assert answers == []
    while thread.is_alive():
        turns.serve()
    assert answers == [threading.get_ident()]


def test_after_training_it_is_done_at_once():
    turns = Turns()
    waiting, early = asked(turns, lambda: "asked while training")
    turns.close()
    waiting.join(5)
    late, answers = asked(turns, threading.get_ident)
    late.join(5)
    assert early == ["asked while training"]
    assert answers == [late.ident]


def test_an_error_belongs_to_the_thread_that_asked():
    turns = Turns()

    def fails():
        raise ValueError("no picture")

    thread, answers = asked(turns, fails)
    while thread.is_alive():
        turns.serve()
    assert str(answers[0]) == "no picture"


def test_missing_libraries_are_named(monkeypatch):
    monkeypatch.setattr(live, "find_spec", lambda name: None if name == "viser" else object())
    with pytest.raises(SettingError, match=r"the viewer needs viser: pip install 'clear-strategies\[view\]'"):
        live.require_viewer()


def answer(address: str) -> bytes:
    connection = HTTPConnection(address.removeprefix("http://"), timeout=20)
    connection.request("GET", "/")
    return connection.getresponse().read()


def test_a_viewer_is_there_while_a_run_trains(tmp_path):
    pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    saved_run.write(tmp_path)
    splat, addresses = open_splat(tmp_path), []
    with live.watched(splat.painter, splat.cameras, "toy", addresses.append) as after_step:
        after_step(1)
        assert b"<html" in answer(addresses[0])
        after_step(2)
    with pytest.raises(OSError, match="refused"):
        answer(addresses[0])
