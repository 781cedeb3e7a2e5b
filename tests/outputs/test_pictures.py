"""Figures, curves and the contact sheet show what they are given and nothing else."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from clear_strategies.outputs import figures
from clear_strategies.outputs.figures import SheetRow, magnification, window, write_contact_sheet, write_tiles
from tests.helpers.image_files import array, holds, read


# ---- what the figures share
@pytest.mark.parametrize(
    ("count", "expected"),
    [(0, []), (1, [0]), (3, [0, 4, 8]), (4, [0, 3, 6, 9]), (10, [*range(10)]), (99, [*range(10)])],
)
def test_spaced_items_are_at_most_as_many_as_asked_for(count: int, expected: list[int]) -> None:
    assert list(figures.spaced(range(10), count)) == expected
    assert list(figures.spaced([], count)) == []


# ---- the contact sheet shows what it is given, pixel for pixel
def row(name: str, seed: int, *, truth: bool = True, size: tuple[int, int] = (40, 60)) -> SheetRow:
    shown = {name: array(seed + k, *size) for k, name in enumerate(("LR, enlarged", "ours"))}
    if truth:
        shown |= {"ground truth": array(seed + 2, *size), "error of ours": array(seed + 3, *size)[..., 0]}
    return SheetRow(name, shown, {"ours": "20.00 dB, SSIM 0.500"})


def test_huge_images_are_reduced_and_truth_and_error_are_shown_where_they_are_known(tmp_path: Path) -> None:
    write_contact_sheet(tmp_path / "sheet.png", [row("a$1_$.png", 0, size=(90, 2000))], "scan $20_$")
    assert read(tmp_path / "sheet.png").shape[1] < 4 * 700
    strip = row("strip", 0, size=(1600, 12))
    write_contact_sheet(tmp_path / "strip.png", [strip], "narrower than a letter")
    write_tiles(tmp_path / "tiles.png", strip.images, "narrower than a letter", columns=3)
    unknown, a, b = row("a", 0, truth=False), row("a", 0), row("b", 10)
    for name, rows in {"none": [unknown], "some": [unknown, b], "all": [a, b]}.items():
        write_contact_sheet(tmp_path / f"{name}.png", rows, "scene")
    none, some, both = (read(tmp_path / f"{name}.png") for name in ("none", "some", "all"))
    assert none.shape[1] < some.shape[1] == both.shape[1]
    assert holds(some, b.images["ground truth"], times=4)


@pytest.mark.parametrize(
    ("sizes", "times"), [([(30, 250), (80, 100)], 1), ([(40, 60)], 4)], ids=["pixel for pixel", "to reach 240"]
)
def test_images_of_any_size_are_shown_at_a_whole_multiple(tmp_path, sizes, times):
    rows = [row("a", 10 * i, size=size) for i, size in enumerate(sizes)]
    write_contact_sheet(tmp_path / "sheet.png", rows, "scene")
    sheet = read(tmp_path / "sheet.png")
    for shown in rows:
        assert all(holds(sheet, image, times=times) for image in shown.images.values() if image.ndim == 3)


def test_of_an_image_that_is_reduced_a_part_is_shown_at_its_own_pixels_and_upright_photos_make_no_tower(
    tmp_path,
) -> None:
    columns = ("LR, enlarged", "SR prior", "ours", "ground truth", "another")
    same = {name: array(k, 1160, 776) for k, name in enumerate(columns)}
    rows = [SheetRow(str(i), same, compared=columns) for i in range(4)]
    write_contact_sheet(tmp_path / "sheet.png", rows, "upright")
    sheet = read(tmp_path / "sheet.png")
    part = window([*same.values()])
    assert all(holds(sheet, image[part], times=1) for image in same.values())
    assert sheet.shape[0] < 3 * sheet.shape[1]
    assert magnification(1160, 776) * 1160 == pytest.approx(384)


def test_parts_of_photos_of_both_orientations_do_not_cover_each_other(tmp_path: Path) -> None:
    shown = [{name: array(k, *size) for k, name in enumerate(("ours", "truth"))} for size in ((612, 816), (816, 612))]
    write_contact_sheet(tmp_path / "sheet.png", [SheetRow("a", images, compared=images) for images in shown], "mixed")
    sheet = read(tmp_path / "sheet.png")
    for images in shown:
        part = window([*images.values()], times=magnification(816, 816))
        assert all(holds(sheet, image[part], times=1) for image in images.values())


def test_every_caption_and_the_small_print_are_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words: list[str] = []
    monkeypatch.setattr(Figure, "text", lambda page, x, y, text, **style: words.append(text))
    row = SheetRow("a", {name: array(0) for name in ("baseline", "ours")}, {"baseline": "20.00 dB", "ours": "21.00 dB"})
    write_contact_sheet(tmp_path / "sheet.png", [row], "scene · strategy", "small print")
    assert {"scene · strategy", "a", "baseline", "ours", "20.00 dB", "21.00 dB", "small print"} <= set(words)
