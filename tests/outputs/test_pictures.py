"""Pictures show what they are given: pixel for pixel, everything that was measured, and nothing that was not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from clear_strategies.outputs import pictures
from clear_strategies.outputs.pictures import SheetRow


def random_image(seed: int, height: int = 40, width: int = 60) -> Tensor:
    """8-bit levels, so that a PNG holds it exactly."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (height, width, 3), generator=generator).float() / 255


def array(seed: int, height: int = 40, width: int = 60) -> np.ndarray:
    return random_image(seed, height, width).numpy()


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def holds(picture: np.ndarray, image: np.ndarray, times: int = 1) -> bool:
    """Whether the image, every pixel `times` larger, is somewhere in the picture, exactly."""
    pixels = (image * 255).round().astype(np.uint8).repeat(times, axis=0).repeat(times, axis=1)
    height, width = pixels.shape[:2]
    corners = np.argwhere((picture[: -height + 1, : -width + 1] == pixels[0, 0]).all(axis=-1))
    return any(np.array_equal(picture[y : y + height, x : x + width], pixels) for y, x in corners)


def row(name: str, seed: int, *, truth: bool = True, size: tuple[int, int] = (40, 60)) -> SheetRow:
    shown = {"LR, enlarged": random_image(seed, *size), "ours": random_image(seed + 1, *size)}
    return SheetRow(name, shown, random_image(seed + 2, *size) if truth else None, "20.00 dB, SSIM 0.500")


def history(n: int = 100, **columns: float) -> list[dict[str, float]]:
    return [{"t": float(t), **{name: value + 0.1 * t / n for name, value in columns.items()}} for t in range(1, n + 1)]


# ── the contact sheet ────────────────────────────────────────────────────────────────────────────────────────────────


def test_large_images_are_shown_pixel_for_pixel(tmp_path: Path) -> None:
    rows = [row("a", 0, size=(30, 250)), row("b", 10, size=(30, 250))]
    pictures.contact_sheet(tmp_path / "sheet.png", rows, "scene · strategy")
    sheet = read(tmp_path / "sheet.png")
    for shown in rows:
        assert shown.truth is not None
        for image in (*shown.images.values(), shown.truth):
            assert holds(sheet, image.numpy())


def test_small_images_are_shown_at_a_whole_multiple(tmp_path: Path) -> None:
    shown = row("a", 0)  # 60 pixels wide: four times, to reach 240
    pictures.contact_sheet(tmp_path / "sheet.png", [shown], "scene · strategy")
    sheet = read(tmp_path / "sheet.png")
    assert all(holds(sheet, image.numpy(), times=4) for image in shown.images.values())


def test_huge_images_are_reduced(tmp_path: Path) -> None:
    pictures.contact_sheet(tmp_path / "sheet.png", [row("a", 0, size=(90, 2000))], "scene")
    assert read(tmp_path / "sheet.png").shape[1] < 4 * 700


def test_truth_and_error_are_shown_where_they_are_known(tmp_path: Path) -> None:
    for name, rows in {
        "none": [row("a", 0, truth=False)],
        "some": [row("a", 0, truth=False), row("b", 10)],
        "all": [row("a", 0), row("b", 10)],
    }.items():
        pictures.contact_sheet(tmp_path / f"{name}.png", rows, "scene")
    none, some, both = (read(tmp_path / f"{name}.png") for name in ("none", "some", "all"))
    assert none.shape[1] < some.shape[1] == both.shape[1]
    truth = row("b", 10).truth
    assert truth is not None
    assert holds(some, truth.numpy(), times=4)


def test_views_of_different_sizes_stand_in_one_sheet(tmp_path: Path) -> None:
    rows = [row("wide", 0, size=(30, 250)), row("tall", 10, size=(80, 100))]
    pictures.contact_sheet(tmp_path / "sheet.png", rows, "scene")
    sheet = read(tmp_path / "sheet.png")
    assert all(holds(sheet, image.numpy()) for shown in rows for image in shown.images.values())


def test_no_rows_make_no_sheet(tmp_path: Path) -> None:
    pictures.contact_sheet(tmp_path / "sheet.png", [], "scene")
    assert not (tmp_path / "sheet.png").exists()


def test_error_is_the_mean_difference_over_rgb() -> None:
    image = np.array([[[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]])
    truth = np.array([[[0.5, 0.5, 0.5], [0.4, 0.3, 0.0]]])
    assert pictures.error_map(image, truth) == pytest.approx(np.array([[0.0, 0.3]]))


# ── curves ───────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "rows",
    [
        [],
        history(1, loss_lr=0.1),
        history(loss_lr=0.1),
        history(loss_lr=0.0, conflict=math.nan),
        history(loss_lr=0.1, loss_base=0.2, loss_hf=0.05, conflict=0.3, conflict_means=0.2, mean_q=0.9, corrected=0.1),
        [*history(5, loss_lr=0.1), {"t": 6.0, "loss_lr": math.inf, "psnr_test": 20.0, "n_gaussians": 100.0}],
    ],
    ids=["nothing", "one iteration", "LR alone", "zeros and NaN", "everything", "an infinity"],
)
@pytest.mark.filterwarnings("error")
def test_curves_draw_whatever_was_measured(tmp_path: Path, rows: list[dict[str, float]]) -> None:
    marks = {"HR from": 5, "HR full": 30, "opacity reset": 30, "anchor": 50}
    pictures.curves(tmp_path / "curves.png", rows, marks, "scene · strategy")
    assert read(tmp_path / "curves.png").shape == (800, 1500, 3)


def test_a_measured_column_changes_the_picture_and_an_unknown_one_does_not(tmp_path: Path) -> None:
    histories = {
        "plain": history(loss_lr=0.1),
        "measured": history(loss_lr=0.1, conflict=0.4),
        "unknown": history(loss_lr=0.1, weather=0.4),
    }
    for name, rows in histories.items():
        pictures.curves(tmp_path / f"{name}.png", rows, {}, "scene")
    plain, measured, unknown = (read(tmp_path / f"{name}.png") for name in ("plain", "measured", "unknown"))
    assert not np.array_equal(plain, measured)
    assert np.array_equal(plain, unknown)


# ── runs side by side ────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_comparison_enlarges_the_part_where_runs_differ_most(tmp_path: Path) -> None:
    base = array(0, 64, 240)
    other = base.copy()
    other[32:48, 120:180] = array(1, 16, 60)  # a quarter of the size each way, on the grid of windows
    other[0, 0] = 1 - other[0, 0]
    pictures.comparison(tmp_path / "c.png", {"one": base, "two": other}, {"one": "20 dB"}, "scene · view")
    picture = read(tmp_path / "c.png")
    for tile in (base, other):
        assert holds(picture, tile[32:48, 120:180], times=4)


def test_equal_runs_and_a_single_run_are_compared_at_the_centre(tmp_path: Path) -> None:
    base = array(0, 64, 240)
    for tiles in ({"one": base}, {"one": base, "two": base}):
        pictures.comparison(tmp_path / "c.png", tiles, {}, "scene · view")
        assert holds(read(tmp_path / "c.png"), base[24:40, 90:150], times=4)


def test_many_runs_go_to_more_lines_and_long_names_are_wrapped(tmp_path: Path) -> None:
    tiles = {f"run {i}, objective.lambda_hr.peak=0.0, objective.lambda_hr.final=0.0": array(i) for i in range(8)}
    pictures.comparison(tmp_path / "c.png", tiles, {}, "scene · view")
    picture = read(tmp_path / "c.png")
    assert picture.shape[1] < 7 * 260
    assert picture.shape[0] > 2 * 2 * 160


def test_nothing_to_compare_makes_no_picture(tmp_path: Path) -> None:
    pictures.comparison(tmp_path / "c.png", {}, {}, "scene")
    assert not (tmp_path / "c.png").exists()


def test_an_overlay_draws_many_runs_and_those_without_history(tmp_path: Path) -> None:
    runs = {f"run {i}": history(20, psnr_test=20.0 + i, conflict=0.1 * i, n_gaussians=100.0) for i in range(9)}
    pictures.overlay(tmp_path / "nine.png", runs, "scene")
    pictures.overlay(tmp_path / "ten.png", {**runs, "empty": []}, "scene")
    assert np.array_equal(read(tmp_path / "nine.png"), read(tmp_path / "ten.png"))
    pictures.overlay(tmp_path / "none.png", {"empty": []}, "scene")
    assert (tmp_path / "none.png").exists()


def test_the_same_input_gives_the_same_file(tmp_path: Path) -> None:
    for name in ("one", "two"):
        pictures.curves(tmp_path / f"{name}.png", history(loss_lr=0.1), {"anchor": 50}, "scene")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
