"""SR images are computed once per content, and computed again if the entry is damaged."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors import Cached, cache_folder
from tests.helpers.networks import Counting, photo


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.bin"
    path.write_bytes(b"weights")
    return path


def worked(counting: Counting, folder: Path, lr: Tensor, factor: int = 2) -> bool:
    """Did the prior have to work, or was the result in the cache?"""
    Cached(counting, folder)("view", lr, factor)
    return bool(counting.calls)


def test_a_result_is_computed_once_and_is_the_same_from_the_cache(model: Path, tmp_path: Path) -> None:
    counting, lr = Counting(str(model)), photo(5, 6)
    cached = Cached(counting, tmp_path / "cache")
    first, again = (cached(name, lr, 2) for name in ("a", "b"))
    assert torch.equal(first, again)
    assert first.stride() == again.stride()  # sums over another layout would have another order
    assert counting.calls == ["a"]
    assert torch.equal(first, images.quantize(first))
    assert cached.label == "counting"


def test_what_changes_the_result_changes_the_key_and_nothing_else_does(model: Path, tmp_path: Path) -> None:
    folder, lr = tmp_path / "cache", photo(5, 6)
    assert worked(Counting(str(model)), folder, lr)
    assert not worked(Counting(str(model)), folder, lr)
    assert not worked(Counting(str(shutil.copy(model, tmp_path / "moved.bin"))), folder, lr)
    assert worked(Counting(str(model), setting=1), folder, lr)
    assert worked(Counting(str(model)), folder, lr, factor=3)
    assert worked(Counting(str(model)), folder, lr + 1 / 255)
    assert worked(Counting(str(model)), folder, lr.reshape(6, 5, 3))
    model.write_bytes(b"other weights")
    assert worked(Counting(str(model)), folder, lr)


@pytest.mark.parametrize("damage", ["truncated", "garbage", "another size"])
def test_a_damaged_entry_is_logged_and_computed_again(model, tmp_path, damage, caplog):
    folder, lr = tmp_path / "cache", photo(16, 16)
    counting = Counting(str(model))
    first = Cached(counting, folder)("view", lr, 2)
    (entry,) = folder.iterdir()
    if damage == "another size":
        write_png(entry, photo(3, 3))
    else:
        entry.write_bytes(entry.read_bytes()[:-40] if damage == "truncated" else b"garbage")
    assert torch.equal(Cached(counting, folder)("view", lr, 2), first)
    assert len(counting.calls) == 2
    assert "a cached SR image is damaged and is computed again" in caplog.text
    assert torch.equal(read_image(entry), first)


def test_a_cache_that_cannot_be_written_costs_time_but_no_result(model, tmp_path, caplog):
    (tmp_path / "file").write_bytes(b"in the way of a folder")
    lr = photo(5, 6)
    assert Cached(Counting(str(model)), tmp_path / "file" / "cache")("view", lr, 2).shape == (10, 12, 3)
    assert "cannot be cached" in caplog.text


def test_the_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    assert Cached(Counting("")).folder == tmp_path / "sr"
    monkeypatch.delenv("CLEAR_CACHE")
    assert cache_folder() == Path.home() / ".cache" / "clear-strategies"
