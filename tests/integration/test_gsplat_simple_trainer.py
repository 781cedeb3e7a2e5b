"""CLEAR in a trainer of the shape of gsplat's examples/simple_trainer.py: `python -m integration.gsplat simple_trainer.py`."""

import copy
import functools
import pickle
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from clear_strategies.data.ply import read_gaussians
from clear_strategies.errors import HostError, SettingError
from integration.replacing import replaced_attribute
from tests.helpers import gsplat_host, toy
from tests.helpers.host_parts import FROM_START, write_sr

gsplat = pytest.importorskip("gsplat", reason="pip install gsplat")
SCRIPT = Path(__file__).parents[1] / "helpers" / "simple_trainer.py"


@pytest.fixture
def launched(monkeypatch, tmp_path, caplog):
    """`run(*options of the trainer, clear=more options of CLEAR)`, the exit status; files go to `tmp_path`."""
    import gsplat.distributed
    import gsplat.rendering

    from integration.gsplat.__main__ import main

    # a function of its own, since CLEAR replaces it in every module
    monkeypatch.setattr(gsplat.rendering, "rasterization", functools.partial(gsplat_host.rasterization))
    monkeypatch.setattr(gsplat.distributed, "cli", lambda fn, cfg, verbose=False: fn(0, 0, 1, cfg))
    monkeypatch.setattr(gsplat, "export_splats", gsplat.export_splats)
    caplog.set_level("INFO")
    write_sr(tmp_path)

    def run(*options, clear=(), script=SCRIPT):
        ours = ["--sr", tmp_path / "sr", *(f"--overrides={override}" for override in FROM_START), *clear]
        return main([*map(str, (*ours, script, "--result_dir", tmp_path, *options))])

    return run


@pytest.fixture
def trainer(launched, monkeypatch, tmp_path):
    """The stand-in as a module, with CLEAR in its Runner."""
    from integration.gsplat import install
    from tests.helpers import simple_trainer

    monkeypatch.setattr(simple_trainer, "rasterization", gsplat.rendering.rasterization)
    monkeypatch.setattr(simple_trainer, "Runner", type("Runner", (simple_trainer.Runner,), {}))
    install(simple_trainer.Runner, sr=tmp_path / "sr", overrides=FROM_START)
    return simple_trainer


def test_its_checkpoint_and_its_ply_are_the_model_that_was_evaluated(launched, tmp_path, caplog):
    assert launched("--pose_noise", "0.01") == 0
    assert "8 merges" in caplog.text  # views are recognised by their index
    assert "refine_stop_iter=4 instead of 7" in caplog.text  # SVS ends densification at half of the steps
    evaluated = torch.load(tmp_path / "image.pt")
    splats = torch.load(tmp_path / "ckpt.pt")["splats"]
    assert set(splats) == {"means", "quats", "scales", "opacities", "sh0", "shN"}
    rendered = gsplat_host.drawn(gsplat_host.rasterization, splats, toy.scene(24).train[0].lr.camera)[0]
    assert torch.allclose(rendered, evaluated, atol=1e-5)
    stored = read_gaussians(tmp_path / "cloud.ply")
    assert torch.allclose(stored.sh0.reshape(-1, 3), splats["sh0"].reshape(-1, 3), atol=1e-6)


def test_a_strategy_that_densifies_has_no_effect_and_says_so(launched, caplog):
    assert launched("--refine_stop_iter", "0", clear=["--strategies", "clear,mcmc"]) == 0
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "MCMC has no effect here: the host keeps its own density control." in warned
    assert "structure change" not in caplog.text


@pytest.mark.parametrize(("reset_every", "largest", "is_told"), [(3, 0.01, True), (3, 10.0, False), (9, 0.01, False)])
def test_pruning_by_size_that_would_remove_many_of_the_first_gaussians_is_told(
    trainer, tmp_path, caplog, reset_every, largest, is_told
):
    cfg = trainer.Config(str(tmp_path))
    cfg.strategy = replace(cfg.strategy, reset_every=reset_every, prune_scale3d=largest)
    runner = trainer.Runner(0, 0, 1, cfg)
    runner.trainset = None  # so that it does not train
    with pytest.raises(TypeError):
        runner.train()
    told = "after step 3, gsplat removes Gaussians larger than prune_scale3d times the scale of the scene, 0.04. Of the first"
    assert (told in caplog.text) == ("Gaussians, 100 % are" in caplog.text) == is_told


def test_options_that_do_not_work_with_two_scales_are_refused_before_the_first_step(launched, tmp_path, caplog):
    assert launched("--app_opt") == 2
    assert "app_opt: CLEAR needs False, got True: its colours are no spherical harmonics." in caplog.text
    assert not (tmp_path / "ckpt.pt").exists()


def test_splats_without_harmonics_are_refused_before_their_photos_are_enlarged(trainer, tmp_path):
    runner = trainer.Runner(0, 0, 1, trainer.Config(str(tmp_path)))
    runner.splats, runner.trainset = {"features": runner.splats["sh0"]}, None
    with pytest.raises(HostError, match="harmonic textures"):
        runner.train()


def test_points_between_photos_are_refused_for_other_than_pinhole_cameras():
    from integration.gsplat.simple_trainer import require_supported

    fisheye = SimpleNamespace(camera_model="fisheye")
    with pytest.raises(SettingError, match="camera_model: CLEAR needs pinhole, got fisheye: points=stereo"):
        require_supported(fisheye, from_stereo=True)
    require_supported(fisheye, from_stereo=False)
    require_supported(SimpleNamespace(), from_stereo=True)


def test_save_lr_writes_the_photos_as_they_are_trained_on_and_stops(launched, tmp_path):
    with pytest.raises(SystemExit) as stopped:
        launched(clear=["--save-lr", tmp_path / "lr"])
    assert stopped.value.code == 0
    assert len(list((tmp_path / "lr").iterdir())) == 3


def test_a_script_without_a_runner_that_trains_exits_with_an_error(launched, caplog, tmp_path):
    script = tmp_path / "other.py"
    script.write_text("from gsplat.distributed import cli\ncli(lambda *_: None, None)")
    assert launched(script=script) == 2
    assert "has no Runner" in caplog.text
    trains = "import torch\np = torch.ones(1, requires_grad=True)\np.sum().backward()\ntorch.optim.SGD([p], 0.1).step()"
    script.write_text(f"{trains}\nopen({str(tmp_path / 'trained')!r}, 'w').close()")
    assert launched(script=script) == 2
    assert "trains, but does not call gsplat's cli" in caplog.text
    assert not (tmp_path / "trained").exists()
    torch.optim.SGD([torch.ones(1, requires_grad=True)], 0.1).step()  # a later one in the same process
    script.write_text("")
    assert launched(script=script) == 1
    assert "trained without CLEAR" in caplog.text


def test_a_gsplat_without_its_modules_is_refused(launched, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "gsplat.distributed", None)
    assert launched() == 2
    assert "has no module gsplat.distributed, which gsplat 1.4 to 1.6 have" in caplog.text


def test_a_process_for_each_gpu_which_would_train_without_clear_is_refused(launched, tmp_path, monkeypatch, caplog):
    from integration.gsplat import install
    from tests.helpers import simple_trainer

    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert launched() == 2
    assert "CLEAR trains in one process, but gsplat would start 2 without it" in caplog.text
    monkeypatch.setattr(simple_trainer, "cli", gsplat.distributed.cli)
    install(type("Runner", (simple_trainer.Runner,), {}), sr=tmp_path / "sr", overrides=FROM_START)
    with pytest.raises(SettingError, match="CUDA_VISIBLE_DEVICES=0"):
        simple_trainer.cli(lambda *_: None, None)
    assert not (tmp_path / "ckpt.pt").exists()


def test_a_second_runner_in_one_process_trains_too(trainer, tmp_path):
    drawn, shown = [], []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        runner = trainer.Runner(0, 0, 1, trainer.Config(str(tmp_path / name)))
        runner.train()
        drawn.append(torch.load(tmp_path / name / "image.pt"))
        assert runner.clear.attachment.counts["merges"] == 8
        shown.append((runner.splats, runner.splats.state_dict()["sh0"]))
    assert torch.equal(*drawn)
    first, sh0 = shown[0]
    assert torch.equal(first["sh0"], sh0)  # f_base + f_det, since nothing adds f_det to its pictures any more
    copied = copy.deepcopy(runner.splats)
    assert torch.equal(copied.state_dict()["sh0"], runner.splats.state_dict()["sh0"])  # f_base + f_det
    assert len(pickle.dumps(copied)) < 50_000  # without the photos
    runner.clear.remove()
    assert not hasattr(gsplat.export_splats, "__wrapped__")  # else the splats of every Runner stay in memory


def test_what_was_replaced_since_stays_when_an_earlier_replacement_ends():
    host = SimpleNamespace(draws=min)
    first, second = replaced_attribute(host, "draws", max), replaced_attribute(host, "draws", sum)
    with first:
        second.__enter__()
    assert host.draws is sum
    second.__exit__(None, None, None)
    assert host.draws is max
