"""dnn_superres: other models, garbage and other scales are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from clear_strategies.data.priors import DnnSuperres
from clear_strategies.errors import DataError, SettingError
from tests.helpers.networks import photo


def test_dnn_superres_of_an_unknown_kind_is_refused() -> None:
    with pytest.raises(SettingError, match=r"prior\.model: must be one of edsr, espcn, fsrcnn, lapsrn, got 'srgan'"):
        DnnSuperres("x.pb", model="srgan")


def test_dnn_superres_with_a_garbage_model_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "garbage.pb"
    path.write_bytes(b"not a graph")
    with pytest.raises(DataError, match=r"garbage\.pb: network: cannot be run as espcn x4") as error:
        DnnSuperres(str(path))("view", photo(8, 12), 4)
    assert "\n" not in str(error.value)


def test_dnn_superres_of_another_scale_is_refused(shared_data: Path) -> None:
    with pytest.raises(DataError, match=r"ESPCN_x4\.pb: network: "):
        DnnSuperres(str(shared_data / "sr_weights" / "ESPCN_x4.pb"))("view", photo(8, 12), 3)
