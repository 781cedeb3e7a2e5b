"""Settings are refused with name, rule, value and remedy: whole numbers, ranges, choices, colours, reader arguments."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from clear_strategies import SplatSuRe, SRStage
from clear_strategies.core.checks import as_color, require_choice, require_number, require_whole
from clear_strategies.data.readers import blender, colmap, demo, nerfstudio, photos
from clear_strategies.errors import SettingError
from clear_strategies.geometry import StereoSettings
from clear_strategies.geometry.sift import TriangulationSettings
from clear_strategies.schedules import LogLinear, WarmupDecay


@pytest.mark.parametrize("value", [2.5, 4.0, True, None, "4", math.nan, 0])
def test_only_whole_numbers_in_range_are_whole_numbers(value: object) -> None:
    require_whole("a.b", 1, least=1)
    require_whole("a.b", 7, least=1, most=7)
    with pytest.raises(SettingError, match=r"a\.b.*at most 7.*8"):
        require_whole("a.b", 8, least=1, most=7)
    with pytest.raises(SettingError) as refusal:
        require_whole("a.b", value, least=1)
    assert str(refusal.value) == f"a.b: must be a whole number of at least 1, got {value!r}: a.b=1"


@pytest.mark.parametrize("value", [0, 2.5, math.nan, math.inf, -math.inf, True, None, "1"])
@pytest.mark.parametrize(
    ("limits", "rule", "remedy"),
    [
        ({"above": 0, "most": 1}, r"must lie in \(0, 1\]", 1),
        ({"above": 0, "below": 2}, r"must lie in \(0, 2\)", 1),
        ({"least": 3}, "must be a finite number >= 3", 4),
    ],
    ids=["most", "below", "least"],
)
def test_numbers_are_finite_and_in_range(limits: dict[str, float], rule: str, remedy: float, value: object) -> None:
    require_number("a.b", remedy, **limits)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match=rf"^a\.b: {rule}, got .*: a\.b={remedy}$"):
        require_number("a.b", value, **limits)  # type: ignore[arg-type]


def test_choices_are_listed_and_the_remedy_is_the_nearest_number_in_range() -> None:
    for value, nearest in ((-1, 0), (101, 100)):
        with pytest.raises(SettingError, match=rf"^a\.b: must lie in \[0, 100\], got {value}: a\.b={nearest}$"):
            require_number("a.b", value, most=100)
    require_choice("a.b", "x", ("x", "y"))
    with pytest.raises(SettingError, match=r"^a\.b: must be one of x, y, got 'z': a\.b=x$"):
        require_choice("a.b", "z", ("x", "y"))


@pytest.mark.parametrize("value", [(1, 1), (1, 1, 2), (math.nan, 0, 0), "white", None, ("1", 0, 0), (1, 1, 1, 1)])
def test_colours_are_three_numbers_between_0_and_1(value: object) -> None:
    assert as_color("a.b", [1, 0.5, 0]) == (1.0, 0.5, 0.0)
    with pytest.raises(SettingError, match=r"^a\.b: must be three numbers in \[0, 1\]"):
        as_color("a.b", value)


def test_readers_refuse_their_arguments_before_files() -> None:
    cases = [(reader.read, {"background": (2.0, 0.0, 0.0)}) for reader in (blender, colmap, nerfstudio)]
    for read, wrong in (*cases, (photos.read, {"max_side": 0}), (photos.read, {"threads": -2})):
        with pytest.raises(SettingError, match=rf"^data\.reader\.{next(iter(wrong))}: "):
            read(Path("nowhere"), **wrong)
    for wrong in ({"width": 0}, {"views": -3}):
        with pytest.raises(SettingError, match=rf"^data\.reader\.{next(iter(wrong))}: "):
            demo.read(**wrong)


REFUSED: dict[Callable[..., object], dict[str, object]] = {
    StereoSettings: {"window": 4, "spacing": 0.5, "trust": 2, "tolerance": 0},
    TriangulationSettings: {
        "enlarge": 0, "max_features": 0, "contrast": 0.0, "ratio": 1.1, "epipolar": -1.0, "reprojection": math.nan, "angle": 0.0,
    },
    SplatSuRe: {"ratio": 0.9, "softness": 0.0, "min_views": 0},
    SRStage: {"count": -1, "reach": 0.0, "weight": 0.0},
    WarmupDecay: {"peak": -1.0},
    LogLinear: {"final": 101.0},
}  # fmt: skip


@pytest.mark.parametrize(("made", "field"), [(made, field) for made, fields in REFUSED.items() for field in fields])
def test_a_class_names_the_field_the_rule_the_value_and_a_remedy(made: Callable[..., object], field: str) -> None:
    with pytest.raises(SettingError, match=f"^{field}: .*must .*, got .*: .+"):
        made(**{field: REFUSED[made][field]})


def test_an_exponential_decay_ends_above_0() -> None:
    with pytest.raises(SettingError, match=r"^final: must be above 0 for an exponential decay, got 0: decay=linear"):
        WarmupDecay(decay="exponential", final=0.0)
