"""Settings as plain values: defaults filled in from signatures, and everything checked before a class is called."""

import random
import sys
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from enum import Enum, Flag
from pathlib import Path
from typing import Any, Literal

import pytest

from clear_strategies.errors import DataError, SettingError
from clear_strategies.settings import LISTED, TARGET, build, with_defaults
from rasterizers.interface import BackendUnavailable


@dataclass(frozen=True, slots=True)
class Inner:
    size: int = 3
    mode: Literal["a", "b", 1] = "a"

    def __post_init__(self) -> None:
        if self.size < 1:
            raise SettingError(f"size must be at least 1, got {self.size}.")
        if self.size == 8:
            raise SettingError("size: must not be 8, got 8: size=7")
        if self.size > 9:
            raise ValueError("it is too large.")


@dataclass(frozen=True, slots=True)
class Outer:
    share: float
    inner: Inner = field(default_factory=Inner)
    names: Sequence[str] | None = None
    color: tuple[float, float] = (0.0, 1.0)
    weights: Mapping[str, float] = field(default_factory=lambda: {"x": 1.0})
    on: bool | Literal["auto"] = "auto"
    hidden: str | None = field(default=None, metadata={LISTED: False})


def call(root: str, depth: int = 2, *, strict: bool = False, **others: Any) -> Any:
    return root, depth, strict, others


def fails(root: str) -> None:
    raise {"data": DataError("file", "field", "is bad", "mend it"), "here": BackendUnavailable("it is not here.")}[root]


def target(kind: Any, **values: Any) -> dict[str, Any]:
    return {TARGET: f"{__name__}.{kind.__name__}", **values}


def test_defaults_come_from_the_signature_and_the_node_wins():
    node = with_defaults(target(Outer, inner={"mode": "b"}, weights={"y": 2.0}))
    inner = {TARGET: f"{Inner.__module__}.Inner", "size": 3, "mode": "b"}
    assert node == target(Outer, inner=inner, names=None, color=[0.0, 1.0], weights={"x": 1.0, "y": 2.0}, on="auto")
    assert with_defaults([target(call, depth=7)]) == [target(call, depth=7, strict=False)]
    node = with_defaults(target(Outer, inner=target(call, root="r")))
    assert node["inner"] == target(call, root="r", depth=2, strict=False)


@pytest.mark.parametrize("kept", [{TARGET: None}, {TARGET: "nowhere.Mine", "x": 1}, {"a": {"b": 1}}, "text"])
def test_what_cannot_be_looked_up_stays_as_it_is(kept):
    assert with_defaults(kept) == kept


def test_a_node_is_built_from_the_inside_out_and_a_partial_waits_for_what_is_missing():
    built = build(target(Outer, share=1, color=[0.5, 1], inner=target(Inner, size=4)))
    assert built == Outer(1, Inner(4), color=(0.5, 1))
    assert build({"a": [target(Inner)], "b": None}) == {"a": [Inner()], "b": None}
    waiting = build(target(call, depth=5, _partial_=True))
    assert waiting("r") == ("r", 5, False, {})
    assert build(target(Outer, share=1.0, on=True)).on is True


@dataclass(frozen=True)
class Listed:
    at: Path = Path("a")
    maybe: Path | str | None = None
    pairs: tuple[tuple[int, int], ...] = ()


def test_a_text_becomes_the_path_and_lists_the_tuples_that_are_asked_for():
    built = build(target(Listed, at="b/c", maybe="d", pairs=[[1, 2], [3, 4]]))
    assert built == Listed(Path("b/c"), "d", ((1, 2), (3, 4)))
    with pytest.raises(SettingError, match=r"pairs: must be a list, each entry a list of 2 numbers, got \[\[1\]\]"):
        build(target(Listed, pairs=[[1]]))
    with pytest.raises(SettingError, match="at: must be a path, got 3"):
        build(target(Listed, at=3))


_MADE = list[object]()


@dataclass(frozen=True)
class Costly:
    table: list[int] = field(default_factory=lambda: _MADE.append(object()) or [1])  # type: ignore[func-returns-value]


def test_the_default_of_a_factory_is_made_once_to_be_compared_with_a_setting():
    _MADE.clear()
    assert build(target(Costly, table=[2])) == Costly([2])
    assert len(_MADE) == 1


class Mode(Enum):
    SOFT = "soft"
    HARD = "hard"


@dataclass(frozen=True)
class Varied:
    """Fields as a user's own class may have them."""

    mode: Mode = Mode.SOFT
    modes: AbstractSet[Mode] = frozenset({Mode.SOFT, Mode.HARD})
    names: set[str] = field(default_factory=set)
    paths: Sequence[Path] = ()
    by_name: dict[str, Path] | None = None
    folders: list[tuple[str, Path]] = field(default_factory=list)
    inner: Inner = Inner(size=5)
    maybe: Inner | None = None
    call: Callable[[float], float] | None = None


def test_settings_become_the_members_of_enums_the_sets_and_the_nested_dataclasses_that_are_asked_for():
    written = {"paths": ["a"], "by_name": {"b": "c"}, "folders": [["d", "e"]]}
    built = build(target(Varied, mode="HARD", modes=["soft"], names=["x"], **written))
    assert built == Varied(Mode.HARD, {Mode.SOFT}, {"x"}, [Path("a")], {"b": Path("c")}, [("d", Path("e"))])
    # As of a class that the command line names, whose defaults are in no file.
    assert build(target(Varied, inner={"mode": "b"}, maybe={"size": 2})) == Varied(inner=Inner(5, "b"), maybe=Inner(2))
    node = with_defaults(target(Varied))
    assert (node["mode"], node["modes"]) == ("SOFT", ["HARD", "SOFT"])
    assert build(node) == Varied()


class Part(Flag):
    MEANS = 1
    SCALES = 2


class Swapped(Enum):
    ONE = "TWO"
    TWO = "ONE"


@dataclass(frozen=True)
class OfObjects:
    """Defaults that a text does not become again by the annotation alone."""

    parts: Part = Part.MEANS | Part.SCALES
    chosen: Literal[Mode.SOFT, "other"] = Mode.SOFT
    either: Mode | str = Mode.HARD
    anything: Any = frozenset({1})
    where: str | Path = Path("there")
    inner: Inner | None = field(default_factory=lambda: Inner(3))
    by_mode: Mapping[Mode, Sequence[Path]] = field(default_factory=lambda: {Mode.SOFT: (Path("a"),)})
    swapped: Swapped = Swapped.TWO
    call: Mapping[str, Any] = field(default_factory=lambda: {"a": print})


def of_objects(mode=Mode.SOFT, some=frozenset({1}), at=(1, 2)):
    return mode, some, at


def test_a_default_that_is_listed_stays_the_object_that_it_is():
    assert build(with_defaults(target(OfObjects))) == OfObjects()
    assert build(with_defaults(target(of_objects))) == of_objects()
    built = build(
        with_defaults(target(OfObjects, chosen="SOFT", either="SOFT", by_mode={"hard": ["b"]}, swapped="ONE"))
    )
    assert (built.chosen, built.either, built.swapped) == (Mode.SOFT, "SOFT", Swapped.ONE)
    assert build(target(OfObjects, by_mode={"hard": ["b"]})).by_mode == {Mode.HARD: [Path("b")]}
    assert not {"parts", "call"} & with_defaults(target(OfObjects)).keys()  # no text stands for these
    with pytest.raises(SettingError, match=r"^chosen: must be SOFT or other, got 'HARD'"):
        build(target(OfObjects, chosen="HARD"))
    with pytest.raises(SettingError, match=r"^size: must be a whole number, got True"):
        build(with_defaults(target(Inner, size=True)))


@pytest.mark.parametrize(
    ("message", "value"),
    [
        ("mode: must be SOFT or HARD, got 'both'.", "both"),
        ("names: must be a list, each entry text, got 'ab'.", "ab"),
        ("paths: must be a list, each entry a path, got [1].", [1]),
        ("folders: must be a list, each entry a list of 2 entries (text, a path), got [['a']].", [["a"]]),
        ("by_name.b: must be a path, got 3. As text it is written 'it.by_name.b=\"3\"'.", {"b": 3}),
        ("call: must be a Callable or null, got 'abs'.", "abs"),
    ],
)
def test_what_is_none_of_these_is_refused_in_words(message, value):
    with pytest.raises(SettingError) as refused:
        build({"it": target(Varied, **{message.split(":")[0].split(".")[0]: value})})
    assert str(refused.value) == f"it.{message}"


REFUSED = {
    "share: must be a number, got 'abc'": {"share": "abc"},
    "share: must be a number, got True": {"share": True},
    "share: must be a finite number, got nan": {"share": float("nan")},
    "share: must be a finite number, got inf": {"share": float("inf")},
    "share: is needed and missing. Add +it.share=….": {},
    "shape: tests.test_settings.Outer has no such setting. Did you mean it.share?": {"share": 1, "shape": 1},
    "zzz: tests.test_settings.Outer has no such setting. There is share, inner": {"share": 1, "zzz": 1},
    "inner: must be a Inner, got 3. Set it.inner.size, it.inner.mode": {"share": 1, "inner": 3},
    "inner.size: must be a whole number, got 2.5": {"share": 1, "inner": target(Inner, size=2.5)},
    "inner.size: must be a whole number, got 2.0": {"share": 1, "inner": target(Inner, size=2.0)},
    "inner.mode: must be a or b or 1, got 'c'": {"share": 1, "inner": target(Inner, mode="c")},
    "inner.mode: must be a or b or 1, got True": {"share": 1, "inner": target(Inner, mode=True)},
    "inner.size must be at least 1, got 0.": {"share": 1, "inner": target(Inner, size=0)},
    "inner.size: must not be 8, got 8: it.inner.size=7": {"share": 1, "inner": target(Inner, size=8)},
    "inner: it is too large.": {"share": 1, "inner": target(Inner, size=10)},
    "inner: nowhere.Mine cannot be imported": {"share": 1, "inner": {TARGET: "nowhere.Mine"}},
    "inner: builtins.nothing cannot be imported": {"share": 1, "inner": {TARGET: "builtins.nothing"}},
    "inner: builtins.type cannot be imported (it is no class or function whose parameters are known": {
        "share": 1,
        "inner": {TARGET: "builtins.type"},
    },
    "names: must be a list, each entry text or null, got [1]": {"share": 1, "names": [1]},
    "names: must be a list, each entry text or null, got 'ab'": {"share": 1, "names": "ab"},
    "color: must be a list of 2 numbers, got [1]": {"share": 1, "color": [1]},
    "weights.x: must be a number, got 'y'": {"share": 1, "weights": {"x": "y"}},
    "weights: must be a table of names, got 3": {"share": 1, "weights": 3},
    "weights.x: must be a finite number, got nan": {"share": 1, "weights": {"x": float("nan")}},
    "on: must be true or false or auto, got 1": {"share": 1, "on": 1},
}


@pytest.mark.parametrize(("message", "values"), REFUSED.items(), ids=list(REFUSED))
def test_a_setting_that_cannot_be_used_is_refused_by_its_key(message, values):
    with pytest.raises(SettingError) as refused:
        build({"it": target(Outer, **values)})
    assert str(refused.value).startswith(f"it.{message}")


def test_files_keep_their_own_error_and_a_backend_that_is_not_there_is_a_setting():
    with pytest.raises(DataError):
        build({"it": target(fails, root="data")})
    with pytest.raises(SettingError, match="it: it is not here"):
        build({"it": target(fails, root="here")})


def test_every_entry_of_a_list_is_checked_and_random_numbers_of_the_program_stay():
    """Trainers of 3DGS choose their views by `random`."""
    for seed in range(8):
        random.seed(seed)
        state = random.getstate()
        with pytest.raises(SettingError, match="names: must be a list"):
            build(target(Outer, share=1, names=["a", "b", "c", 1]))
        assert build(target(Outer, share=1, names=["a", "b"])).names == ["a", "b"]
        assert random.getstate() == state


def test_what_a_decorator_refuses_is_named_by_the_file_of_the_class(tmp_path, monkeypatch):
    (tmp_path / "of_her_own.py").write_text(
        "from dataclasses import dataclass\n@dataclass\nclass Mine:\n    a: list = []\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SettingError, match=r"of_her_own\.py:2: ValueError: mutable default .* Correct that file"):
        build({TARGET: "of_her_own.Mine"}, "it")


@pytest.mark.skipif(sys.version_info < (3, 14), reason="Python evaluates annotations where they are written")
def test_annotations_may_name_what_only_type_checkers_import(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text(
        "from dataclasses import dataclass\n"
        "from typing import TYPE_CHECKING\n"
        "from clear_strategies import Strategy\n"
        "if TYPE_CHECKING:\n"
        "    from pathlib import Path\n"
        "@dataclass(frozen=True)\n"
        "class Own(Strategy):\n"
        "    where: Path | None = None\n"
        "    factor: float = 1.0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    node = {TARGET: "own.Own", "factor": 2.0}
    assert with_defaults(node)["where"] is None
    assert build(node, "strategies.own").factor == 2.0
