"""`bench next_photo`: the photo nearest to the advised places is compared with others, and a training is made once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from clear_strategies.bench import next_photo
from clear_strategies.bench.results import Results
from clear_strategies.data.capture import Frame
from clear_strategies.errors import DataError
from tests.helpers import wall
from tests.helpers.finished_run import make_run

PLACES = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
FRAMES = {f"p{i}": Frame(f"p{i}.png", wall.at(x), lambda: torch.zeros(40, 60, 3)) for i, x in enumerate(PLACES)}


@pytest.fixture
def request_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> next_photo.Request:
    monkeypatch.setattr(next_photo, "_photos", lambda *_: FRAMES)
    start = [frame.camera for frame in next_photo.evenly_spaced(list(FRAMES.values()), 3)]
    splat = SimpleNamespace(painter=wall.painter(), poses=lambda: start)
    monkeypatch.setattr(next_photo, "open_splat", lambda _: splat)
    return next_photo.Request(["fit.iterations=3"], ["wall"], 3, 4, 0, tmp_path)


def test_the_table_compares_the_advised_photo_with_others(request_of: next_photo.Request) -> None:
    trained: list[Sequence[str]] = []

    def trainer(folder: Path, overrides: Sequence[str]) -> None:
        names = overrides[-1].count("'") // 2
        trained.append(overrides)
        make_run(folder, psnr=20.0 + names)

    results = Results("next_photo", lambda _: None)
    next_photo.measure(results, request_of, trainer)
    (row,) = results.tables["next_photo"].to_dict("records")
    assert (row["before"], row["advised_gain"], row["others_gain"], row["others"]) == (23.0, 1.0, 1.0, 4)
    assert row["advised"] in {f"p{i}.png" for i in (1, 2, 3, 5, 6, 7)}
    assert trained[0][-1] == "data.views.train_names=['p0','p4','p8']"
    count = len(trained)
    assert 5 <= count <= 6
    next_photo.measure(results, request_of, trainer)
    assert len(trained) == count


def test_a_failed_training_is_told(request_of: next_photo.Request) -> None:
    with pytest.raises(DataError, match="no room"):
        next_photo.measure(Results("next_photo", lambda _: None), request_of, lambda *_: "no room")


def test_too_few_photos_are_refused(request_of: next_photo.Request, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(next_photo, "_photos", lambda *_: dict(list(FRAMES.items())[:4]))
    with pytest.raises(DataError, match="4 are no test photos, 5 are needed"):
        next_photo.measure(Results("next_photo", lambda _: None), request_of)
