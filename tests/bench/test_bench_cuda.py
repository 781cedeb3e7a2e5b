"""What the benchmark does on a GPU, as far as a CPU can show it: floors, peers, the pass over the Gaussians, the steps of
`bench device`.
"""

from __future__ import annotations

import json
import sys
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir

import rasterizers
from clear_strategies.bench import (
    accuracy,
    counting,
    device,
    gaussians,
    iteration,
    machine,
    output,
    peaks,
    peers,
    rounds,
    scenes,
)
from clear_strategies.bench import rasterizers as drawing
from clear_strategies.bench.__main__ import _parser, main
from clear_strategies.bench.counting import Cost, Load
from clear_strategies.bench.peaks import Peaks
from clear_strategies.errors import DataError
from clear_strategies.run import CONF
from rasterizers import Camera, Splats, autograd

ONE = Load(n=1, visible=1, bands=0, pixels=1, contributions=1)
FAST = {**scenes.SETTINGS, **rasterizers.PRESETS["fast"]}


@pytest.fixture(scope="module")
def tiny() -> scenes.Workload:
    found = scenes.load("tiny")
    assert isinstance(found, scenes.Workload)
    return found


# --- floors -----------------------------------------------------------------------------------------------------------


def test_drawing_reads_a_gaussian_and_writes_a_pixel_once():
    # 11 numbers of its shape and 3 of its colour in, 4 of the pixel out; 148 + 12 + 9 operations, 12 + 9 for the pixel.
    assert counting.forward(ONE) == Cost(4 * 18, 190)
    unseen = Load(n=101, visible=1, bands=0, pixels=1, contributions=1)
    assert counting.forward(unseen) == Cost(4 * (18 + 100 * 3), 190)
    assert counting.forward(Load(1, 1, 15, 1, 1)) == Cost(4 * (18 + 45), 190 + 15 * 9)


def test_the_way_back_costs_more_with_each_cotangent_but_not_as_much_again():
    # Pixel 3 + 1, Gaussian 11 + 9 in; 16 and the basis out. 21 + 29 operations the pixel, 148 and twice that the Gaussian.
    assert counting.backward(ONE, 1) == Cost(4 * (4 + 20 + 17), 50 + 444)
    assert counting.backward(ONE, 2) == Cost(4 * (7 + 20 + 33), 79 + 740)
    assert counting.backward(Load(1, 1, 15, 1, 1), 1).bytes == 4 * (4 + 29 + 32)


def test_losses_adam_and_the_pass_over_the_gaussians_are_counted():
    assert counting.ssim(100) == Cost(1200, 100 * (8 * 44 + 3 + 30 + 4))
    assert counting.photometric(100) == Cost(1200, 100 * 393)
    assert counting.haar(4) == Cost(48, 34)
    assert counting.adam(10) == Cost(280, 130)
    # 62 numbers with moments in and out and an anchor; 14 factors of each of three gradients, the basis and the filter.
    assert counting.gaussian_pass(1, 15, 3, anchored=True).bytes == 4 * (62 * 7 + 42 + 17)
    assert counting.gaussian_pass(1, 15, 1, anchored=False) == Cost(4 * (62 * 6 + 14 + 17), 62 * 13 + 48)
    assert Cost(1, 2) + Cost(3, 4) == Cost(4, 6)


def splat(sigma: float, opacity: float, depth: float = 1.0) -> Splats:
    return Splats(
        torch.tensor([[0.0, 0.0, depth]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), sigma * depth / 16),
        torch.tensor([opacity]), torch.zeros(1, 1, 3), torch.zeros(1, 0, 3),
    )  # fmt: skip


SIXTEEN = Camera(torch.eye(4), 16.0, 16.0, 8.0, 8.0, 16, 16)
PLAIN = {"kernel": 0.0, "near": 0.1, "alpha_max": 0.999, "antialiased": False, "transmittance_min": 1e-4}


def test_a_gaussian_contributes_to_the_pixels_within_its_reach():
    # σ = 2 px: alpha = 0.5 exp(-r²/8) >= 0.5 exp(-1/2) within r = 2. Of r² = 0.5 there are 4 pixels, of 2.5 there are 8.
    rules = {**PLAIN, "alpha_min": 0.5 * 0.6065306}
    assert counting.contributions_of(splat(2.0, 0.5), SIXTEEN, rules) == (1, 12)
    assert counting.contributions_of(splat(2.0, 0.5), SIXTEEN, rules, tile=5) == (1, 12)
    # Of the opacity the kernel leaves 4 / (4 + 4): nowhere as much as asked for.
    assert counting.contributions_of(splat(2.0, 0.5), SIXTEEN, {**rules, "kernel": 4.0, "antialiased": True}) == (0, 0)
    assert counting.contributions_of(splat(2.0, 0.5, depth=0.05), SIXTEEN, rules) == (0, 0)


@pytest.mark.parametrize(("least", "expected"), [(0.2, 0), (0.05, 256), (0.005, 512)])
def test_a_pixel_ends_before_too_little_light_is_left(least, expected):
    """Two that cover the image with alpha = 0.9: 0.1 of the light is left after one, 0.01 after both."""
    front, back = splat(1e4, 0.9), splat(1e4, 0.9, depth=2.0)
    both = Splats(*(torch.cat((getattr(back, f), getattr(front, f))) for f in Splats.__slots__[:6]))
    rules = {**PLAIN, "alpha_min": 1 / 255, "transmittance_min": least}
    assert counting.contributions_of(both, SIXTEEN, rules) == (2, expected)


def test_what_is_counted_is_what_is_drawn(tiny):
    """Opaque black: each contribution darkens. As visible as the specification says, but for a box against an ellipse."""
    load = counting.load_of(tiny, FAST)
    rendering = rasterizers.load("torch", preset="fast", **scenes.SETTINGS)(tiny.splats, tiny.camera)
    drawn = int(rendering.visible.sum())
    assert drawn <= load.visible <= 1.05 * drawn
    assert (load.n, load.bands, load.pixels) == (600, 15, 96 * 72)
    assert 5 < load.contributions / load.pixels < 12


def test_a_stage_is_held_against_what_the_device_was_seen_to_do():
    limits = Peaks(bandwidth=1e9, flops=1e9)
    costs = {"move": Cost(2e6, 1e6), "reckon": Cost(1e6, 4e6)}
    assert [limits.ms(cost) for cost in costs.values()] == [2.0, 4.0]
    took = {("a", "move"): 4.0, ("b", "reckon"): 8.0, ("b", "wait"): 1.0}
    columns = peaks.attained("T", took, costs, limits).columns
    assert columns["who"] == ["a", "b"]
    assert columns["of the bandwidth"] == ["50 %", "12.5 %"]
    assert columns["of the arithmetic"] == ["25 %", "50 %"]
    assert columns["floor, ms"] == ["2.00", "4.00"]


def test_the_limits_are_measured(monkeypatch):
    monkeypatch.setitem(peaks._COPIED, "cpu", 1 << 16)
    monkeypatch.setitem(peaks._SIDE, "cpu", 64)
    found = Peaks.measured("cpu")
    assert found.bandwidth > 1e7
    assert found.flops > 1e7
    assert "GB/s" in found.says()


# --- peers ------------------------------------------------------------------------------------------------------------


def errors(peer: peers.Peer, workload: scenes.Workload) -> accuracy.Errors:
    v = drawing.noise(workload)[0]
    rules = {**peer.differs, **rasterizers.PRESETS[peers.PRESET]}
    truth = accuracy.oracle("torch", workload.splats, workload.camera, v, rules)
    return accuracy.compare(peer.picture(workload, v), truth)


def test_gsplat_is_called_as_it_wants_and_judged_by_its_rules(tiny):
    def rasterization(*tensors, **settings):
        return autograd.rasterization(*tensors, **settings, backend="torch")

    peer = peers.gsplat(rasterization, "stand-in")
    assert not peer.differs
    found = errors(replace(peer, differs={"alpha_max": 0.99}), tiny)  # the stand-in's cap
    assert found.image["p99.99"] < 1e-5
    assert max(found.relative.values()) < 1e-3


class Inria:
    """A library of the shape that Inria's rasterizer and gswarp have, around our specification."""

    GaussianRasterizationSettings = namedtuple(
        "GaussianRasterizationSettings",
        "image_height image_width tanfovx tanfovy bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered "
        "auto_tune_verbose",
    )

    class GaussianRasterizer:
        def __init__(self, settings) -> None:
            self.s = settings

        def __call__(self, means3D, means2D, opacities, dc, shs, scales, rotations):
            s = self.s
            camera = Camera(
                s.viewmatrix.T, s.image_width / 2 / s.tanfovx, s.image_height / 2 / s.tanfovy, s.image_width / 2,
                s.image_height / 2, s.image_width, s.image_height,
            )  # fmt: skip
            torch.testing.assert_close(camera.center, s.campos)
            assert torch.allclose(rotations.norm(dim=-1), torch.ones(len(rotations)))
            own = {"kernel": 0.3, "near": 0.2, "alpha_max": 0.99, "antialiased": False, "preset": "fast"}
            splats = Splats(means3D, rotations, scales, opacities[:, 0], dc, shs)
            drawn = autograd.draw(rasterizers.load("torch", **own), splats, camera)
            clip = torch.cat((means3D.detach(), torch.ones(len(means3D), 1)), 1) @ s.projmatrix
            ndc = clip[:, :2] / clip[:, 3:]
            centres = ((ndc + 1) * torch.tensor([s.image_width, s.image_height]) - 1) / 2 + 0.5
            torch.testing.assert_close(
                centres[drawn.visible], drawn.means2d.detach()[drawn.visible], atol=1e-3, rtol=1e-4
            )
            return drawn.image.movedim(-1, 0), None, None


def test_gswarp_is_called_as_it_wants_and_judged_by_its_rules(tiny):
    found = errors(peers.gswarp(Inria, "stand-in"), tiny)
    assert found.image["p99.99"] < 1e-5
    assert max(found.relative.values()) < 1e-3


def test_peers_that_are_missing_or_broken_are_said_in_a_line_each(monkeypatch):
    def broken(version):
        raise RuntimeError("no compiler\nand a long story")

    monkeypatch.setattr(peers, "_PEERS", {"no-such-package": broken, "torch": broken})
    said = []
    assert peers.found(said.append) == []
    assert said == [
        "no-such-package: not installed (pip install no-such-package).", "torch: it cannot be used (no compiler).",
    ]  # fmt: skip


@pytest.mark.skipif(torch.cuda.is_available(), reason="there they may run")
def test_without_cuda_no_peer_runs():
    said = []
    assert peers.found(said.append) == []
    assert {line.partition(":")[0] for line in said} == {"gsplat", "gswarp"}


def test_k_cotangents_are_k_passes_of_a_peer(tiny):
    pulled = []
    peer = peers.Peer("peer", lambda workload: peers.Drawing(torch.zeros(1, 1, 3), pulled.append), "draws nothing.")
    ms = drawing.PeerTurn(peer, tiny, drawing.noise(tiny))()
    assert list(ms) == [drawing.FORWARD, *drawing.BACKWARD]
    assert len(pulled) == 1 + 2 + 3


def test_peers_stand_over_ours_with_what_they_do_differently(tiny):
    stages = (drawing.FORWARD, *drawing.BACKWARD)
    ours = drawing.Row("s", "warp", "fast", {stage: [2.0] for stage in stages})
    exact = drawing.Row("s", "warp", "exact", {stage: [9.0] for stage in stages})
    theirs = drawing.Row("s", "peer", "fast", {stage: [3.0] for stage in stages}, is_peer=True)
    drawing.add_ratios([ours, exact, theirs])
    peer = peers.Peer("peer", lambda workload: peers.Drawing(torch.zeros(1, 1, 3), dict), "not deterministic.")
    _, ratios = drawing._sections([ours, exact, theirs], "s", None, [peer], explained=False)
    assert ratios.columns == {
        "peer": ["peer"], "over": ["warp fast"], "forward": ["1.50x"], "+ backward K=1": ["1.50x"],
        "+ backward K=2": ["1.50x"], "+ backward K=3": ["1.50x"],
    }  # fmt: skip
    assert "peer: not deterministic." in ratios.notes


def test_gsplat_is_no_backend_of_ours(monkeypatch):
    monkeypatch.setattr(rasterizers, "available", lambda: {"gsplat": None, "torch": None})
    traits = SimpleNamespace(traits=SimpleNamespace(devices={"cuda"}))
    monkeypatch.setattr(rasterizers, "load", lambda name: traits)
    said = []
    assert drawing.usable(None, "cuda", said.append) == ["torch"]
    assert said == ["gsplat: no backend of ours; on CUDA it takes part as a peer"]


def test_a_run_with_a_peer_has_its_errors_by_its_rules(tiny, monkeypatch):
    peer = peers.gswarp(Inria, "peer")
    request = drawing.Request(["tiny"], ["torch"], ["fast"], 1, 60.0, memory=False)
    scene = drawing.OnScene("tiny", tiny, request, None, [peer], drawing.Calibration(), lambda line: None)
    ours, theirs = scene.measure(["torch"], "torch")
    assert theirs.is_peer
    assert theirs.same.relative["means"] < 1e-3 < theirs.none.relative["means"]
    assert set(theirs.against) == {"torch"}
    assert not ours.against


# --- the pass over the Gaussians, and an iteration --------------------------------------------------------------------


def test_the_pass_is_timed_in_one_and_one_by_one_and_moves_nothing():
    said = []
    found = gaussians.measure(50, 1, "cpu", said.append)
    assert (gaussians.FUSED in found.ms) == (not said)
    assert {gaussians.READABLE, "torch, fused Adam", "torch, foreach Adam"} <= set(found.ms)
    table, floors = found.sections(Peaks(1e9, 1e9))
    assert table.columns["what"][-1] == gaussians.STEP
    assert floors.columns["MB at least"][-1] == output.number(50 * 62 * 28 / 1e6)
    assert len(found.sections(None)) == 1


def test_both_ways_take_the_same_step():
    ways = [gaussians._Ours(50, "cpu", fused=fused) for fused in (True, False)]
    for way in ways:
        way()
    one, other = (way.optimizer.first for way in ways)
    for name, moments in one.items():
        assert float(moments.abs().max()) > 0, name
        torch.testing.assert_close(moments, other[name], rtol=1e-3, atol=1e-10)


def test_an_iteration_without_hf_pulls_one_cotangent_back(tiny):
    request = iteration.Request("tiny", "clear", "torch", "fast", 1, prototype=Path("nowhere"), floors=True)
    said = []
    findings = iteration.measure(request, said.append)
    stages, floors = findings.sections
    assert list(stages.columns) == ["stage", "clear, LR + HR, ms", "K=1 (no L_HF), ms", "LR only, ms"]
    assert "An iteration without L_HF costs" in stages.notes[0]
    assert "target" not in " ".join(stages.notes).lower()
    assert {"render", "backward HR", "total"} <= set(floors.columns["stage"])
    assert said == ["prototype: its build.sh is not here; give its folder with --prototype."]


@pytest.mark.parametrize(("ms", "verdict"), [(5.0, "reached"), (7.0, "missed")])
def test_the_target_stands_below_the_table(ms, verdict):
    median = {name: {"total": ms} for name in ("clear", iteration._WITHOUT_HF, iteration._LR_ONLY)}
    section = iteration._section("T", "clear", median, iteration.TARGETS[1008, 756])
    assert f"Target at this size: 6 ms; {verdict} ({ms:.2f} ms)." in section.notes


def test_the_floor_of_an_iteration_is_that_of_its_stages(tiny):
    view = iteration.view_of(tiny, rasterizers.load("torch", preset="fast", **scenes.SETTINGS))
    costs = iteration.floors(tiny, view, FAST, anchored=True)
    total = costs.pop("total")
    assert total.bytes == sum(cost.bytes for cost in costs.values())
    assert costs["backward HR"] == counting.backward(counting.load_of(tiny, FAST), 2)


def test_warm_ups_do_not_count():
    turns = iter(range(100))
    assert rounds.interleaved({"a": lambda: {"all": float(next(turns))}}, 2, warm_ups=3) == {"a": {"all": [3.0, 4.0]}}


def test_the_device_is_named_with_its_driver_and_libraries(monkeypatch):
    properties = SimpleNamespace(major=9, minor=0, multi_processor_count=132, total_memory=1 << 37)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H200")
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda: properties)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(machine, "_said", lambda *command: "580.1" if command[0] == "nvidia-smi" else "unknown")
    monkeypatch.setattr(machine, "_version", {"warp-lang": "1.19.0"}.get)
    facts = machine.machine(2)
    assert facts["cuda"] == {
        "driver": "580.1", "toolkit": "13.0", "capability": "9.0", "multi_processor_count": 132, "total_memory": 1 << 37,
        "versions": {"warp-lang": "1.19.0"},
    }  # fmt: skip
    assert "; NVIDIA H200, driver 580.1, CUDA 13.0, warp-lang 1.19.0; torch" in machine.sentence(facts)


# --- everything, step by step -----------------------------------------------------------------------------------------


def request(tmp_path: Path, **options) -> device.Request:
    return device.Request(tmp_path / "out", **{"device": "cpu", "quick": True, **options})


def says(text: str, code: int = 0) -> list[str]:
    return [sys.executable, "-c", f"print({text!r}); raise SystemExit({code})"]


def test_a_failed_step_stops_no_other_and_each_has_its_log(tmp_path, monkeypatch, capsys):
    def unexpected() -> str:
        raise device.Unexpected("two files differ")

    wanted = [
        device.Step("first, a failure", says("it broke", 3)),
        device.Step("compares", says("done"), learn=unexpected),
        device.Step("works", says("done"), learn=lambda: "learnt"),
        device.Step("no GPU", says("never"), "there is none"),
        device.Step("no program", [str(tmp_path / "absent")]),
    ]
    monkeypatch.setattr(device, "steps", lambda request: wanted)
    out = tmp_path / "out"
    assert main(["device", "--device", "cpu", "--out", str(out)]) == 1
    steps = json.loads((out / "summary.json").read_text())["steps"]
    assert [step["result"] for step in steps] == ["failed", "failed", "passed", "not run", "failed"]
    assert [step["says"] for step in steps][:4] == [
        "exit code 3: it broke",
        "two files differ",
        "learnt",
        "there is none",
    ]
    assert (out / "logs" / "01_first_a_failure.log").read_text() == "it broke\n"
    assert not (out / "logs" / "04_no_gpu.log").exists()
    assert (out / "summary.md").read_text() == capsys.readouterr().out


def test_what_cannot_run_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(device.shutil, "which", lambda name: None)
    on_cpu = {step.name: step for step in device.steps(request(tmp_path, quick=False))}
    assert on_cpu["compute-sanitizer racecheck"].why_not == "it looks at CUDA alone"
    assert on_cpu["first use, kernels compiled"].why_not == "it is what compiling for CUDA takes"
    assert on_cpu["train, fern 252x189 -> 1008x756"].why_not == "give the folder that holds fern with --data-root"
    (tmp_path / "fern" / "images_4").mkdir(parents=True)
    on_cuda = {step.name: step for step in device.steps(request(tmp_path, device="cuda", quick=False, root=tmp_path))}
    assert "not on the PATH" in str(on_cuda["compute-sanitizer memcheck"].why_not)
    assert on_cuda["train, fern 252x189 -> 1008x756"].why_not is None
    assert "images_2 is not there" in str(on_cuda["train, fern 504x378 -> 2016x1512"].why_not)
    assert on_cuda["tests"].command[-1].endswith("tests")
    for name, step in on_cuda.items():
        if name.startswith("bench"):
            assert step.command[step.command.index("--device") + 1] == "cuda"


def test_a_sanitized_training_has_no_cached_memory_and_a_rehearsal_no_gpu(tmp_path, monkeypatch):
    monkeypatch.setattr(device.shutil, "which", lambda name: f"/bin/{name}")
    (memcheck, racecheck) = device._sanitized(request(tmp_path, device="cuda"))
    assert list(memcheck.command[:5]) == ["/bin/compute-sanitizer", "--tool", "memcheck", "--error-exitcode", "9"]
    assert racecheck.command[2] == "racecheck"
    assert memcheck.environment == {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    assert memcheck.why_not is None
    assert device._environment(request(tmp_path))["CUDA_VISIBLE_DEVICES"] == ""


def test_two_trainings_are_compared_bit_by_bit(tmp_path):
    asked = request(tmp_path)
    _, again = device._again(asked)
    for name in ("once", "twice"):
        (asked.out / "checks" / name).mkdir(parents=True)
        (asked.out / "checks" / name / "point_cloud.ply").write_bytes(b"same")
    assert "the same bits" in again.learn()
    (asked.out / "checks" / "twice" / "point_cloud.ply").write_bytes(b"others")
    with pytest.raises(device.Unexpected, match="differ"):
        again.learn()


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(DataError, match="must be a new folder"):
        device.measure(request(tmp_path), lambda line: None)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is one")
def test_without_a_gpu_the_check_does_not_begin(tmp_path, caplog):
    assert main(["device", "--out", str(tmp_path / "out")]) == 2
    assert "torch sees no such device" in caplog.records[-1].getMessage()


@pytest.mark.parametrize("quick", [True, False])
def test_every_step_is_a_command_that_its_program_understands(tmp_path, quick):
    (tmp_path / "fern" / "images_4").mkdir(parents=True)
    for step in device.steps(
        request(tmp_path, device="cuda", quick=quick, root=tmp_path, data=tmp_path, scenes=(tmp_path,))
    ):
        words = [str(word) for word in step.command]
        module, arguments = words[words.index("-m") + 1], words[words.index("-m") + 2 :]
        if module == "clear_strategies.bench":
            assert _parser().parse_args(arguments).device == "cuda"
        elif module == "clear_strategies.run":
            overrides = [argument for argument in arguments if not argument.startswith("hydra.")]
            with initialize_config_dir(str(CONF), version_base="1.3"):
                config = compose("config", overrides)
            assert config.fit.device == "cuda"
            assert set(config.strategies) == {"gco", "p2g", "svs"}
        else:
            assert module == "pytest"


@pytest.mark.slow
def test_a_rehearsal_on_a_cpu_trains_and_measures(tmp_path, monkeypatch, capsys):
    """`bench device --device cpu --quick`, of which the steps that repeat themselves are left out."""
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path / "cache"))
    every, kept = device.steps, {"bench kernels", "train, demo", "first use, kernels compiled"}
    monkeypatch.setattr(device, "steps", lambda asked: [step for step in every(asked) if step.name in kept])
    out = tmp_path / "out"
    assert main(["device", "--device", "cpu", "--quick", "--out", str(out)]) == 0, capsys.readouterr().out
    results = {step["name"]: step["result"] for step in json.loads((out / "summary.json").read_text())["steps"]}
    assert results == {"bench kernels": "passed", "train, demo": "passed", "first use, kernels compiled": "not run"}
    assert "demo: seconds by stage" in (out / "summary.md").read_text()
    assert "SSIM" in (out / "kernels.md").read_text()
