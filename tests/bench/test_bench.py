"""How the benchmark measures: scenes, turns, errors, and what each question times. No test asserts how long anything takes."""

import json
import math
from functools import partial

import pandas as pd
import pytest
import torch

import rasterizers
from clear_strategies import GCO, P2G, SVS, DataError, Objective
from clear_strategies.bench import iteration, scenes
from clear_strategies.bench import rasterizers as drawing
from clear_strategies.bench import results as timing
from clear_strategies.bench.__main__ import main
from clear_strategies.bench.rasterizers import ATTRIBUTES
from clear_strategies.bench.results import Results
from clear_strategies.outputs.results import export_ply
from tests.helpers import command_line, toy
from tests.helpers.backends import why_not
from tests.stress.bad_inputs import plys


@pytest.fixture(scope="module")
def tiny() -> scenes.Workload:
    return scenes.load("tiny")


@pytest.fixture(scope="module")
def reference() -> rasterizers.Rasterizer:
    return rasterizers.load("torch", preset="fast", **scenes.SETTINGS)


def measured(question, **options) -> Results:
    results = Results()
    question.measure(results, **options)
    return results


@pytest.mark.parametrize(("device", "warm_ups"), [("cpu", 1), ("cuda", 3)])
def test_contenders_take_turns_and_warm_ups_do_not_count(device, warm_ups):
    order = []

    def turn(name: str) -> dict[str, float]:
        order.append(name)
        return {"stage": float(len(order))}

    turns = timing.interleaved({name: partial(turn, name) for name in "ab"}, 3, device=device, label="")
    assert order == ["a", "b"] * (3 + warm_ups)
    first = 2 * warm_ups + 1
    assert list(turns.query("contender == 'a'")["ms"]) == [first, first + 2, first + 4]
    assert timing.medians(turns).loc["b", "stage"] == first + 3


def test_each_row_names_the_module_whose_kernels_ran():
    if why_not("cpp"):
        pytest.skip(str(why_not("cpp")))
    tables = measured(drawing, scene=["tiny"], backend=["cpp"], preset=["fast"], repeats=1, device="cpu").tables
    for table in ("rasterizers_time", "rasterizers_error"):
        assert set(tables[table]["module"]) == {rasterizers.load("cpp").module}


def test_the_reference_takes_no_part_in_large_scenes_and_unavailable_backends_are_noted(monkeypatch):
    results = Results()
    with pytest.raises(DataError, match="measures none of these scenes"):
        drawing.measure(results, scene=["s100k-lr"], backend=["torch"], preset=["fast"], repeats=1, device="cpu")
    assert any("at most 10,000 Gaussians" in note for note in results.notes)
    monkeypatch.setattr(rasterizers, "available", lambda: {"quick": "no compiler", "torch": None})
    notes = []
    assert drawing.usable([], "cpu", notes.append) == ["torch"]
    assert notes == ["quick: no compiler"]
    with pytest.raises(DataError, match="cannot run here"):
        drawing.usable(["quick"], "cpu", notes.append)


def test_errors_are_those_of_their_definitions():
    def drawn(image: list[float], gradient: list[list[float]]) -> drawing.ImageAndGradients:
        return {"image": torch.tensor(image), **dict.fromkeys(drawing.ATTRIBUTES, torch.tensor(gradient))}

    truth = drawn([0.0, 0, 0], [[3.0, 4], [0, 0], [1, 0]])
    found = drawn([0.3, 0, 0], [[3.0, 4], [0, 1], [2, 0]])
    errors = drawing.errors_of(found, truth)
    assert errors["image_max"] == pytest.approx(0.3)
    assert errors["image_mean"] == pytest.approx(0.1)
    assert errors["means_relative"] == pytest.approx(math.sqrt(2 / 26))
    assert errors["means_median"] == 0.0  # the lower of 0 and 1; the second Gaussian has no gradient


def test_finer_cut_offs_have_smaller_errors(tiny):
    v = drawing.random_cotangents(tiny)[0]
    truth = drawing.truth_of("torch", tiny, v, drawing.NO_CUT_OFFS)
    renders = [drawing.Contestant(tiny, "torch", preset).render for preset in rasterizers.PRESETS]
    found = [drawing.errors_of(drawing.draw(render, v), truth) for render in renders]
    for name in drawing.ATTRIBUTES:
        fast, accurate, exact = (errors[f"{name}_relative"] for errors in found)
        assert fast > 3 * accurate > 9 * exact, name
        assert exact < 1e-4


def test_an_iteration_trains_clear_and_moves_nothing(tiny, reference):
    view = iteration.view_of(tiny, reference)
    training = iteration.Training(tiny, view, reference, Objective())
    assert training.state.conductor.strategies == (GCO(), P2G(), SVS())
    before = {name: t.clone() for name, t in training.state.field.raw().items()}
    ms = training()
    assert {"render", "losses LR", "backward HR", iteration.TOTAL} <= set(ms)
    assert all(torch.equal(t, before[name]) for name, t in training.state.field.raw().items())
    assert float(training.state.density.count.sum()) > 0
    assert training.state.history[-1]["lambda_hr"] > 0.9


def test_an_iteration_is_measured_with_and_without_hr():
    tables = measured(iteration, scene="tiny", backend="torch", repeats=1, device="cpu").tables
    table = tables["iteration"].set_index("stage")
    assert list(table.columns) == ["lr_and_hr_ms", "without_l_hf_ms", "lr_only_ms", "error"]
    stages = ["render", "losses LR", "backward LR", "losses HR", "evidence", "backward HR", "per-Gaussian pass"]
    assert 0 < table.loc[stages, "error"].max() < 1e-4
    assert list(table.index[-2:]) == [iteration.REST, iteration.TOTAL]
    assert math.isnan(table.loc["backward HR", "lr_only_ms"])


# ---- what the benchmark draws
def test_a_generated_scene_is_the_same_every_time_and_has_its_stated_statistics():
    scene, again = (scenes.surfaces("s", 20_000, 1008, 756, radius=5.5) for _ in range(2))
    for name in ATTRIBUTES:
        assert torch.equal(getattr(scene.splats, name), getattr(again.splats, name)), name
    splats, camera = scene.splats, scene.camera
    pose = camera.world_to_camera
    x, y, z = (splats.means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height) & (z > 0)
    radius = 3 * splats.scales.amax(-1) * camera.fx / z
    spread = float(radius[inside].quantile(0.9) / radius[inside].median())
    assert 0.78 < float(inside.float().mean()) < 0.88
    assert float(radius[inside].median()) == pytest.approx(5.5, rel=0.05)
    assert spread == pytest.approx(math.exp(0.8 * 1.2816), rel=0.05)  # lognormal, σ = 0.8
    assert float(splats.opacities.median()) == pytest.approx(1 / (1 + math.exp(-0.8)), abs=0.02)
    assert splats.shN.shape == (20_000, 15, 3)


def test_an_exported_field_is_drawn_as_the_field_draws_itself(tmp_path):
    field = iteration.field_of(toy.splats(30))
    export_ply(tmp_path / "field.ply", field)
    workload = scenes.load(str(tmp_path / "field.ply"))
    rasterizer = rasterizers.load("torch", preset="exact", **scenes.SETTINGS)
    found = rasterizer(workload.splats, workload.camera)
    torch.testing.assert_close(found.image, field.render(rasterizer, workload.camera), atol=1e-4, rtol=0)
    assert float(found.visible.float().mean()) > 0.7
    (tmp_path / "none.ply").write_bytes(plys.ply(count=0, body=b""))
    with pytest.raises(DataError, match="has no Gaussians"):
        scenes.load(str(tmp_path / "none.ply"))


# ---- the benchmark's command line: its files, its exit codes, and the data files of docs/explanation/benchmarks.md
def test_rasterizers_writes_every_stage_both_errors_a_figure_and_the_machine(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    asked = ["rasterizers", "--scene", "tiny", "--repeats", "1", "--preset", "fast", "--backend", "torch"]
    main([*asked, "--out", str(out)])
    time, error, turns = (pd.read_csv(out / f"rasterizers_{table}.csv") for table in ("time", "error", "turns"))
    assert list(time["backend"]) == ["torch"]
    assert time.loc[0, "k2_over_k1"] == pytest.approx(time["backward_k2_ms"][0] / time["backward_k1_ms"][0], rel=1e-4)
    stages = (drawing.FORWARD, *drawing.BACKWARD, drawing.TOGETHER, drawing.SEPARATE)
    assert list(turns["stage"]) == list(stages)
    assert list(error["truth"]) == [drawing.SAME, drawing.NONE]
    assert error["means_relative"][0] < 1e-4 < error["means_relative"][1]
    assert (out / "time_against_error.png").stat().st_size > 5_000
    facts = json.loads((out / "rasterizers.json").read_text())
    assert facts["options"] == {"device": "cpu", "repeats": 1}
    assert {"date", "platform", "python", "torch", "nvidia_gpu_models"} <= set(facts["machine"])
    assert str(tmp_path) not in json.dumps(facts)
    assert "forward_ms" in capsys.readouterr().out


NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rasterizers", "--scene", "nowhere"], "nowhere: is no scene"),
        (["rasterizers", "--scene", "tiny", "--backend", "cuda"], "cuda: is no backend"),
        (["iteration", "--scene", "nowhere"], "nowhere: is no scene"),
        pytest.param(["rasterizers", "--device", "cuda"], "no such device", marks=NO_GPU),
    ],
)
def test_unusable_input_is_refused(arguments, message, tmp_path):
    with pytest.raises(DataError, match=message):
        main([*arguments, "--out", str(tmp_path)])


def test_a_folder_that_cannot_be_made_is_known_before_measuring(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        main(["iteration", "--out", str(tmp_path / "file")])


@pytest.mark.slow
def test_host_measures_a_loop_alone_and_with_a_strategy(tmp_path):
    asked = ["host", "--strategies", "clear", "--gaussians", "300", "--width", "16", "--repeats", "2", "--threads", "1"]
    done = command_line.run(*asked, "--out", ".", cwd=tmp_path, module="clear_strategies.bench")
    assert done.returncode == 0, done.stderr
    host, error = (pd.read_csv(tmp_path / f"{name}.csv").set_index("loop") for name in ("host", "host_error"))
    assert list(host.index) == ["alone", "clear"]
    assert host["operations"]["clear"] - host["operations"]["alone"] <= 60
    assert host["reads"]["clear"] < host["reads"]["alone"] + 0.5  # whether f_det is stepped on is looked at once
    assert host["merge_ms"]["clear"] > 0
    assert error.loc["clear", ["means", "quats", "scales", "opacities", "sh0", "shN"]].max() < 1e-3
