"""The benchmark is a program: what it draws, how it takes turns and what it says are tested, never how long it takes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import rasterizers
from clear_strategies.bench import accuracy, iteration, memory, output, prototype, rounds, scenes
from clear_strategies.bench import kernels as losses
from clear_strategies.bench.__main__ import main
from clear_strategies.bench.rasterizers import (
    BACKWARD,
    FORWARD,
    PROTOTYPE,
    SEPARATE,
    SHARED,
    TILES,
    Calibration,
    Row,
    Turn,
    add_ratios,
    demand,
    noise,
    usable,
)
from clear_strategies.errors import DataError
from clear_strategies.kernels import losses as kernels
from clear_strategies.outputs.export import export_ply
from clear_strategies.training.checkpoint import Checkpoint, save
from tests.helpers import toy


@pytest.fixture(scope="module")
def tiny() -> scenes.Workload:
    found = scenes.load("tiny")
    assert isinstance(found, scenes.Workload)
    return found


def drawn(workload: scenes.Workload, preset: str = "fast"):
    return rasterizers.load("torch", preset=preset, **scenes.SETTINGS)(workload.splats, workload.camera)


# --- scenes -----------------------------------------------------------------------------------------------------------


def test_a_generated_scene_is_the_same_every_time(tiny):
    again = scenes.load("tiny")
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert torch.equal(getattr(again.splats, name), getattr(tiny.splats, name)), name


def test_a_generated_scene_has_the_statistics_it_is_named_for():
    scene = scenes.surfaces("s", 20_000, 1008, 756, radius=5.5)
    splats, camera = scene.splats, scene.camera
    pose = camera.world_to_camera
    x, y, z = (splats.means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height) & (z > 0)
    radius = 3 * splats.scales.amax(-1) * camera.fx / z
    opacities = splats.opacities
    assert 0.78 < float(inside.float().mean()) < 0.88
    assert float(radius[inside].median()) == pytest.approx(5.5, rel=0.05)
    assert float(radius[inside].quantile(0.9) / radius[inside].median()) == pytest.approx(
        math.exp(0.8 * 1.2816), rel=0.05
    )
    assert float(opacities.median()) == pytest.approx(1 / (1 + math.exp(-0.8)), abs=0.02)
    assert splats.shN.shape == (20_000, 15, 3)
    assert bool((splats.scales > 0).all())


def test_discs_lie_on_their_surfaces():
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    normals[:3] = torch.tensor([[0, 0, 1.0], [0, 0, -1], [0, 1, 0]])
    from rasterizers.geometry import rotation_matrix

    quats = torch.from_numpy(scenes._facing(normals.double().numpy(), np.linspace(0, 6, 50)))
    third = rotation_matrix(quats)[:, :, 2]
    assert torch.allclose((third * normals).sum(-1).abs(), torch.ones(50, dtype=torch.float64), atol=1e-6)


def test_the_lr_scene_holds_the_same_gaussians():
    lr = scenes.to_lr(scenes.surfaces("s", 100, 64, 48, radius=4.0), "s-lr")
    assert (lr.camera.width, lr.camera.height) == (16, 12)


def test_the_garden_is_made_of_its_points(tmp_path):
    g = np.random.default_rng(0)
    file = tmp_path / scenes.GARDEN_FILE
    np.savez(
        file, means3d=g.normal(size=(50, 3)).astype(np.float32), colors=g.integers(0, 255, (50, 3), np.uint8),
        viewmats=np.eye(4, dtype=np.float32)[None], Ks=np.eye(3, dtype=np.float32)[None] * 20, width=64, height=48,
    )  # fmt: skip
    for data in (file, tmp_path):
        found = scenes.load("garden", data)
        assert isinstance(found, scenes.Workload)
        assert (len(found.splats), found.camera.width) == (50, 64)
    file.write_bytes(b"not an archive")
    with pytest.raises(DataError, match="is not the garden"):
        scenes.load("garden", file)


def test_a_garden_that_is_not_here_is_a_reason_not_an_error(tmp_path):
    assert "--data" in str(scenes.load("garden", tmp_path))


def test_a_ply_and_a_checkpoint_of_one_field_draw_the_same_picture(tmp_path):
    field = iteration.field_of(toy.splats(30))
    field.detail.data += 0.1
    field.filter_3d += 0.01
    export_ply(tmp_path / "field.ply", field)
    tensors = {f"field/{name}": t for name, t in {**field.raw(), "filter_3d": field.filter_3d}.items()}
    folder = save(tmp_path, Checkpoint(7, tensors, {}, {"degree": 1.0}, []))
    ply, saved = scenes.load(str(tmp_path / "field.ply")), scenes.load(str(folder))
    found, expected = (drawn(workload, "exact").image for workload in (ply, saved))
    assert torch.allclose(found, expected, atol=1e-4), float((found - expected).abs().max())
    assert float(drawn(ply).visible.float().mean()) > 0.7
    assert str(tmp_path) not in saved.name


def test_what_is_no_scene_is_named_with_the_known_ones():
    with pytest.raises(DataError, match=r"nowhere.*s100k"):
        scenes.load("nowhere")


def test_more_gaussians_and_more_pixels_are_more_work(tiny):
    small = scenes.load("small")
    assert small.work() > 3 * tiny.work()


# --- turns ------------------------------------------------------------------------------------------------------------


def test_contenders_take_turns_and_the_first_round_does_not_count():
    order = []

    def contender(name: str):
        def turn():
            order.append(name)
            return {"stage": float(len(order))}

        return turn

    times = rounds.interleaved({"a": contender("a"), "b": contender("b")}, 2)
    assert order == ["a", "b"] * 3
    assert times == {"a": {"stage": [3.0, 5.0]}, "b": {"stage": [4.0, 6.0]}}
    assert rounds.medians(times["a"]) == {"stage": 4.0}


def test_a_turn_times_every_stage(tiny):
    ms = Turn(rasterizers.load("torch", **scenes.SETTINGS), tiny, noise(tiny))()
    assert list(ms) == [FORWARD, *BACKWARD, TILES, SHARED, SEPARATE]
    assert all(value > 0 for value in ms.values())


def test_a_quarter_of_the_tiles_is_asked_for(tiny):
    mask = demand(rasterizers.load("torch", tile=8), tiny)
    assert mask.shape == (9, 12)
    assert int(mask.sum()) == 27


def test_predictions_grow_with_the_work(tiny):
    calibration = Calibration()
    seconds = calibration.predict(("x", "fast"), lambda scene: lambda: {"all": 1000.0}, tiny)
    assert seconds == pytest.approx(tiny.work() / scenes.load("small").work())


def test_ratios_compare_the_same_cut_offs():
    def row(backend: str, preset: str, ms: float) -> Row:
        return Row("s", backend, preset, {stage: [ms] for stage in (FORWARD, *BACKWARD)}, backend == PROTOTYPE)

    ours, other, peer = row("cpp", "fast", 2.0), row("cpp", "exact", 4.0), row(PROTOTYPE, "fast", 3.0)
    add_ratios([ours, other, peer])
    assert {backend: ratio[BACKWARD[0]] for backend, ratio in peer.against.items()} == {"cpp": 1.5}
    assert not ours.against
    assert not other.against


def test_unknown_backends_are_refused_and_unavailable_ones_said(monkeypatch):
    with pytest.raises(DataError, match=r"cuda.*torch"):
        usable(["cuda"], "cpu", lambda line: None)
    monkeypatch.setattr(rasterizers, "available", lambda: {"quick": "no compiler", "torch": None})
    said = []
    assert usable(None, "cpu", said.append) == ["torch"]
    assert said == ["quick: no compiler"]
    assert usable(["quick", "torch"], "cuda", said.append) == ["torch"]
    with pytest.raises(DataError, match="cannot run here"):
        usable(["quick"], "cpu", said.append)


# --- accuracy and memory ----------------------------------------------------------------------------------------------


def test_float64_has_no_error_against_itself(tiny):
    truth = accuracy.oracle("torch", tiny.splats, tiny.camera, noise(tiny)[0], accuracy.NO_CUT_OFFS)
    errors = accuracy.compare(truth, truth)
    for table in (errors.image, errors.relative, errors.median):
        assert set(table.values()) == {0.0}


def test_errors_are_what_they_are_called():
    def picture(image: list[float], gradient: list[list[float]]) -> accuracy.Picture:
        g = torch.tensor(gradient)
        return accuracy.Picture(
            torch.tensor(image).view(1, -1, 3),
            {name: g[:, 0] if name == "opacities" else g for name in accuracy.ATTRIBUTES},
        )

    truth = picture([0.0, 0, 0], [[3.0, 4], [0, 0], [1, 0]])
    found = picture([0.3, 0, 0], [[3.0, 4], [0, 1], [2, 0]])
    errors = accuracy.compare(found, truth)
    assert errors.image["max"] == pytest.approx(0.3)
    assert errors.image["mean"] == pytest.approx(0.1)
    assert errors.relative["means"] == pytest.approx(math.sqrt(2 / 26))
    assert errors.median["means"] == 0.0  # of 0 and 1, the lower; the second Gaussian has no gradient


def test_finer_cut_offs_are_closer_to_none(tiny):
    v = noise(tiny)[0]
    truth = accuracy.oracle("torch", tiny.splats, tiny.camera, v, accuracy.NO_CUT_OFFS)
    found = []
    for preset in rasterizers.PRESETS:
        rasterizer = rasterizers.load("torch", preset=preset, **scenes.SETTINGS)
        found.append(accuracy.compare(accuracy.draw(rasterizer, tiny.splats, tiny.camera, v), truth))
    for name in accuracy.ATTRIBUTES:
        assert found[0].relative[name] > 3 * found[1].relative[name] > 9 * found[2].relative[name], name
        assert found[2].relative[name] < 1e-4


def test_memory_is_measured_in_a_child_and_a_failure_is_a_reason():
    found = memory.peaks("tiny", None, "torch", ["fast"], 1, device="cpu", seconds=60)
    assert isinstance(found, dict)
    assert 0 < found["fast"] < 2000
    assert memory.peaks("tiny", None, "torch", ["fast"], 1, device="cpu", seconds=0.01) == "it took more than 0 s"


# --- the other questions ----------------------------------------------------------------------------------------------


def test_grouped_convolution_is_the_ssim_that_3dgs_trains_with():
    x, y = losses.images(40, 30)
    peer = losses.grouped_convolution(losses._nchw(x.double()), losses._nchw(y.double()))
    assert float(peer) == pytest.approx(float(losses.ssim(x.double(), y.double()).value), abs=1e-12)


def test_losses_are_held_against_float64(capsys):
    findings = losses.measure(losses.Request(["48x32"], 1), lambda line: None)
    rows = {(row["loss"], row["name"]): row for row in findings.raw["rows"]}
    assert {loss for loss, _ in rows} == {losses.SSIM, losses.PHOTOMETRIC, losses.HAAR}
    assert rows[losses.SSIM, "ours, torch"]["error"] < 1e-6
    assert rows[losses.SSIM, losses._GROUPED]["error"] < 1e-3


def test_another_implementation_takes_part_under_its_name(monkeypatch):
    torch_module = losses.importlib.import_module("clear_strategies.kernels.losses.reference")
    both = {"torch": torch_module, "quick": torch_module}
    monkeypatch.setattr(kernels, "implementations", lambda device: both)
    assert [c.name for c in losses._ours(losses.HAAR)] == ["ours, torch", "ours, quick"]


def test_an_iteration_stands_still_and_has_everything_on(tiny):
    rasterizer = rasterizers.load("torch", preset="fast", **scenes.SETTINGS)
    view = iteration.view_of(tiny, rasterizer)
    from clear_strategies.merging.conductor import Conductor

    training = iteration.Training(
        tiny, view, rasterizer, Conductor(*iteration.STRATEGIES["clear"](), statistics_from=500)
    )
    before = {name: t.clone() for name, t in training.state.field.raw().items()}
    ms = training()
    assert {"render", "losses LR", "backward HR", "total"} <= set(ms)
    assert {"strategies", "optimizer"} <= set(ms) or "per-Gaussian pass" in ms
    assert all(torch.equal(t, before[name]) for name, t in training.state.field.raw().items())
    assert training.state.conductor.state_dict()  # the anchor
    assert float(training.state.density.count.sum()) > 0
    assert training.state.history[-1]["lambda_hr"] > 0.9


# --- what it says -----------------------------------------------------------------------------------------------------


def test_numbers_have_three_digits():
    assert [output.number(x) for x in (0.1234, 1.234, 12.34, 123.4, 12345.0, 0.0, None, math.nan)] == [
        "0.123", "1.23", "12.3", "123", "12,345", "0", "–", "–",
    ]  # fmt: skip
    assert [output.small(x) for x in (2.14e-3, 0.0, 1.0, None)] == ["2.1e-3", "0", "1.0e0", "–"]


def test_only_the_part_between_the_markers_changes():
    page = "head\n\n<!-- bench:kernels -->\nold\n<!-- /bench:kernels -->\n\ntail\n"
    expected = "head\n\n<!-- bench:kernels -->\n\nnew\n\n<!-- /bench:kernels -->\n\ntail\n"
    once = output.between_markers(page, "kernels", "new\n", source=Path("page.md"))
    assert once == expected
    assert output.between_markers(once, "kernels", "new", source=Path("page.md")) == expected


@pytest.mark.parametrize(
    "page", ["", "<!-- /bench:x --> <!-- bench:x -->", "<!-- bench:x --><!-- bench:x --><!-- /bench:x -->"]
)
def test_a_page_without_its_markers_is_refused(page):
    with pytest.raises(DataError, match="bench:x"):
        output.between_markers(page, "x", "new", source=Path("page.md"))


def test_the_documentation_has_the_markers():
    page = Path(__file__).resolve().parents[2] / "docs" / "benchmarks.md"
    for question in ("rasterizers", "kernels", "iteration", "pareto", "device"):
        output.between_markers(page.read_text(), question, "", source=page)


def test_columns_without_a_figure_are_left_out_and_skips_are_listed():
    findings = output.Findings(
        "kernels", 1, [output.Section("T", {"a": ["1"], "b": [output.UNKNOWN]}, ("note",))], ["x: why"]
    )
    text = output.markdown(findings)
    assert "| a |" in text
    assert "b" not in text.split("note")[0].replace("Tab", "")
    assert "- x: why" in text
    assert "1 thread;" in text


# --- the peer ---------------------------------------------------------------------------------------------------------


def test_a_prototype_that_is_not_here_is_a_reason(tmp_path):
    with prototype.started(tmp_path, 1) as peer:
        assert "build.sh is not here" in str(peer)


def test_a_prototype_that_does_not_build_is_a_reason(tmp_path, monkeypatch):
    for name in prototype._FILES:
        (tmp_path / name).write_text("echo 'error: no OpenMP' >&2\n")
    monkeypatch.setattr(prototype, "_INSTRUCTIONS", set())
    monkeypatch.setattr(prototype.shutil, "which", lambda name: name)
    with prototype.started(tmp_path, 1) as peer:
        assert peer == "it cannot be built (error: no OpenMP)"


FAKE_BINDING = """
import numpy as np
class Lib:
    def __init__(self, path): self.l = self
    def gs_free(self, c): pass
def opt(**settings): return settings
def cam(pose, K): return pose
class GS:
    def __init__(self, library): self.c = 0
    def project(self, g, camera, w, h, o): self.size = (h, w, 3)
    def bin(self): pass
    def forward(self): return np.full(self.size, 0.5, np.float32)
    def backward(self, cotangents): self.k = len(cotangents)
    def pbwd(self, g, geometry, colour):
        if self.k > 2: raise SystemExit('three are too many')
        geometry[0][:] = np.arange(11); colour[0][:] = 7
"""


def test_the_prototype_answers_from_a_process_of_its_own(tmp_path, monkeypatch, tiny):
    for name in prototype._FILES:
        (tmp_path / name).write_text('touch "$1/libgs.so"\n')
    (tmp_path / "gs.py").write_text(FAKE_BINDING)
    monkeypatch.setattr(prototype, "_INSTRUCTIONS", set())
    monkeypatch.setattr(prototype.shutil, "which", lambda name: name)
    cuts = rasterizers.PRESETS["fast"]
    with prototype.started(tmp_path, 1) as peer:
        assert isinstance(peer, prototype.Prototype)
        peer.scene(tiny, noise(tiny))
        assert peer.forward(cuts) >= 0
        assert peer.backward(2) >= 0
        picture = peer.picture(cuts)
        assert picture.image.shape == (72, 96, 3)
        assert picture.gradients["quats"][0].tolist() == [3, 4, 5, 6]
        assert picture.gradients["shN"].shape == (600, 15, 3)
        with pytest.raises(prototype.PrototypeError, match="three are too many"):
            peer.backward(3)
    assert not (tmp_path / "__pycache__").exists()


# --- the command line -------------------------------------------------------------------------------------------------


def test_the_command_leaves_json_markdown_and_a_picture(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:rasterizers -->\n<!-- /bench:rasterizers -->\n")
    files = {name: tmp_path / "new" / f"out.{name}" for name in ("json", "markdown", "picture")}
    asked = ["rasterizers", "--scene", "small", "--repeats", "1", "--no-memory", "--docs", str(page)]
    asked += ["--preset", "fast", "--backend", "torch", "--prototype", str(tmp_path)]
    assert main([*asked, *(word for name, path in files.items() for word in (f"--{name}", str(path)))]) == 0
    content = json.loads(files["json"].read_text())
    assert {"cpu", "cores", "threads", "versions", "python", "commit"} <= set(content["machine"])
    assert [row["preset"] for row in content["rows"]] == ["fast"]
    assert all(len(times) == 1 for row in content["rows"] for times in row["ms"].values())
    assert content["rows"][0]["same"]["relative"]["means"] < 1e-4 < content["rows"][0]["none"]["relative"]["means"]
    text = files["markdown"].read_text()
    assert text == capsys.readouterr().out
    assert text.strip() in page.read_text()
    assert "prototype: its build.sh is not here" in text
    assert str(tmp_path) not in text
    with Image.open(files["picture"]) as picture:
        assert picture.size[0] > 300


def test_the_command_says_what_would_take_too_long(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Calibration, "predict", lambda *arguments: 1e4)
    monkeypatch.setitem(scenes._MADE, "large", scenes._MADE["tiny"])
    asked = ["rasterizers", "--scene", "large", "--repeats", "1", "--preset", "fast", "--prototype", str(tmp_path)]
    assert main(asked) == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["rasterizers", "--scene", "nowhere"], "nowhere: is no scene"),
        (["rasterizers", "--scene", "tiny", "--backend", "cuda"], "cuda: is no backend"),
        (["rasterizers", "--docs", "absent.md"], "absent.md: No such file"),
        pytest.param(
            ["rasterizers", "--device", "cuda"],
            "no such device",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is one"),
        ),
        (["kernels", "--size", "9x9"], "9x9: must be WIDTHxHEIGHT"),
        (["iteration", "--scene", "nowhere"], "nowhere: is no scene"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_exit_code_2(arguments, said, caplog, capsys):
    assert main(arguments) == 2
    assert said in caplog.records[-1].getMessage()
    assert "\n" not in caplog.records[-1].getMessage()


@pytest.mark.parametrize(
    "arguments",
    [
        ["rasterizers", "--repeats", "0"],
        ["rasterizers", "--preset", "best"],
        ["nothing"],
        ["rasterizers", "--limit", "-1"],
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_other_questions_leave_their_tables(tmp_path, capsys):
    assert main(["kernels", "--size", "32x16", "--repeats", "1", "--gaussians"]) == 0
    assert "SSIM, with its gradient" in capsys.readouterr().out
    json_file = tmp_path / "i.json"
    asked = ["iteration", "--scene", "tiny", "--repeats", "1", "--prototype", str(tmp_path), "--json", str(json_file)]
    assert main(asked) == 0
    assert "10,000 such iterations" in capsys.readouterr().out
    assert json.loads(json_file.read_text())["strategy"] == "clear"
