"""The contact sheet shows what it is given, pixel for pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from clear_strategies.outputs.contact_sheet import OWN_PHOTO, SheetRow, write_contact_sheet
from clear_strategies.outputs.figures import LINE, PixelPage
from tests.helpers.image_files import holds, random_image, read


def row(name: str, seed: int, *, truth: bool = True, size: tuple[int, int] = (40, 60)) -> SheetRow:
    shown = {"LR, enlarged": random_image(seed, *size), "ours": random_image(seed + 1, *size)}
    return SheetRow(name, shown, random_image(seed + 2, *size) if truth else None, {"ours": "20.00 dB, SSIM 0.500"})


def test_huge_images_are_reduced_and_dollars_in_names_are_no_mathematics(tmp_path: Path) -> None:
    write_contact_sheet(tmp_path / "sheet.png", [row("a$1_$.png", 0, size=(90, 2000))], "scan $20_$")
    assert read(tmp_path / "sheet.png").shape[1] < 4 * 700


def test_truth_and_error_are_shown_where_they_are_known(tmp_path: Path) -> None:
    for name, rows in {
        "none": [row("a", 0, truth=False)],
        "some": [row("a", 0, truth=False), row("b", 10)],
        "all": [row("a", 0), row("b", 10)],
    }.items():
        write_contact_sheet(tmp_path / f"{name}.png", rows, "scene")
    none, some, both = (read(tmp_path / f"{name}.png") for name in ("none", "some", "all"))
    assert none.shape[1] < some.shape[1] == both.shape[1]
    truth = row("b", 10).truth
    assert holds(some, truth.numpy(), times=4)


@pytest.mark.parametrize(
    ("sizes", "times"), [([(30, 250), (80, 100)], 1), ([(40, 60)], 4)], ids=["pixel for pixel", "to reach 240"]
)
def test_images_of_any_size_are_shown_at_a_whole_multiple(tmp_path, sizes, times):
    rows = [row("a", 10 * i, size=size) for i, size in enumerate(sizes)]
    write_contact_sheet(tmp_path / "sheet.png", rows, "scene")
    sheet = read(tmp_path / "sheet.png")
    for shown in rows:
        assert all(holds(sheet, image.numpy(), times=times) for image in (*shown.images.values(), shown.truth))


def test_the_columns_are_in_the_order_of_the_row(tmp_path: Path) -> None:
    names = ("LR, enlarged", "SR prior", "baseline", "ours")
    shown = {name: torch.full((30, 250, 3), 0.1 * i) for i, name in enumerate(names, 1)}
    truth = torch.full((30, 250, 3), 0.9)
    write_contact_sheet(tmp_path / "sheet.png", [SheetRow("a", shown, truth)], "scene")
    middle = read(tmp_path / "sheet.png")[5 * LINE + 15, :, 0].astype(int)
    levels = [round(255 * level) for level in (0.1, 0.2, 0.3, 0.4, 0.9)]
    found = [np.flatnonzero(abs(middle - level) <= 1) for level in levels]
    assert all(len(columns) >= 250 for columns in found)
    assert [columns[0] for columns in found] == sorted(columns[0] for columns in found)


def test_every_caption_and_the_small_print_are_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words: list[str] = []
    monkeypatch.setattr(PixelPage, "text", lambda page, x, y, text, **style: words.append(text))
    shown = {name: torch.rand(40, 60, 3) for name in ("baseline", "ours")}
    row = SheetRow("a", shown, None, {"baseline": "20.00 dB", "ours": "21.00 dB"})
    write_contact_sheet(tmp_path / "sheet.png", [row], "scene · strategy")
    assert {"scene · strategy", "a", "baseline", "ours", "20.00 dB", "21.00 dB", OWN_PHOTO} <= set(words)
