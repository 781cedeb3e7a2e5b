"""Where a job computes: which rasterizer, which device, and what is refused."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from clear_strategies import Strategy
from clear_strategies.compose import tree
from clear_strategies.errors import SettingError
from clear_strategies.jobs import device, job
from clear_strategies.jobs.device import RasterizerSettings, drawn_on
from clear_strategies.jobs.settings import JobSettings, settings_of
from rasterizers.reference import ReferenceRasterizer
from tests.helpers.command_line import TINY
from tests.helpers.configs import composed


@dataclass(frozen=True)
class Theirs(ReferenceRasterizer):
    """A third party's rasterizer, with a setting of its own."""

    sharpness: float = 1.0


@dataclass(frozen=True)
class Draws(Strategy):
    """Logs by which kernel it would draw."""

    def regularize(self, params, t):
        self.log("kernel", self.rasterizer.kernel)


def settings(*overrides: str) -> JobSettings:
    return settings_of(tree(composed(*overrides)))


def test_a_device_that_is_not_there_or_that_the_rasterizer_does_not_draw_on_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SettingError, match=r"fit\.device: is cuda, and torch finds no CUDA device"):
        device.load_rasterizer(RasterizerSettings(), "cuda")
    with pytest.raises(SettingError, match="is cuda, and the rasterizer cpp draws on cpu alone"):
        drawn_on(frozenset({"cpu"}), "cpp", "cuda")


@pytest.mark.parametrize(
    ("devices", "asked", "there", "expected"),
    [({"cpu"}, None, True, "cpu"), ({"cuda"}, None, True, "cuda"), ({"cpu", "cuda"}, None, True, "cuda"),
     ({"cpu", "cuda"}, None, False, "cpu"), ({"cpu", "cuda"}, "cpu", True, "cpu"), ({"cuda"}, "cuda", True, "cuda")],
)  # fmt: skip
def test_null_is_cuda_where_torch_finds_it_and_the_rasterizer_draws_there(devices, asked, there, expected, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    assert drawn_on(frozenset(devices), "this", asked) == expected


def test_warp_gets_the_device_of_the_job(monkeypatch):
    given = {}

    def load(name, **settings):
        given[name] = settings
        return ReferenceRasterizer()

    monkeypatch.setattr("rasterizers.load", load)
    for asked, expected in (("cpu", "cpu"), (None, None)):
        ready = device.load_rasterizer(RasterizerSettings(name="warp"), asked)
        assert (ready.name, ready.device) == ("warp", "cpu")
        assert given["warp"].get("device") == expected


@pytest.mark.parametrize("chosen", [(), ("+method=3dgs_lr",)])
def test_the_method_says_whether_opacities_are_compensated(chosen: tuple[str, ...]):
    assert device.load_rasterizer(settings(*chosen).rasterizer, None).rules.antialiased == (not chosen)


def test_a_rasterizer_of_another_package_is_a_target_with_the_same_settings():
    target = f"rasterizer._target_={__name__}.Theirs"
    found = settings(target, "rasterizer.kernel=0.3", "rasterizer.near=1e-5", "+rasterizer.sharpness=2").rasterizer
    white, nothing = (1.0, 1.0, 1.0), torch.zeros(0, 3)
    ready = device.load_rasterizer(found, None).of_scene(white, nothing)
    assert (type(ready.rasterizer), ready.name) == (Theirs, "Theirs")
    assert (ready.rules.kernel, ready.rules.near) == (0.3, 1e-5)
    assert (ready.rasterizer.sharpness, ready.rasterizer.background) == (2, white)
    assert ready.make().background == white
    blue = settings(target, "rasterizer.background=[0,0,1]").rasterizer
    own = device.load_rasterizer(blue, None).of_scene(white, nothing)
    assert own.rasterizer.background == (0, 0, 1)
    with pytest.raises(SettingError, match=r"rasterizer.sharp: .* Did you mean rasterizer.sharpness\?"):
        settings(target, "+rasterizer.sharp=2")
    with pytest.raises(SettingError, match="rasterizer: kernel must be"):
        device.load_rasterizer(settings(target, "rasterizer.kernel=-1").rasterizer, None)
    with pytest.raises(SettingError, match="rasterizer: Path is no Rasterizer"):
        device.load_rasterizer(device.functools.partial(Path), None)


def test_a_strategy_draws_by_the_rasterizer_of_the_run(tmp_path: Path):
    words = [*TINY, f"+strategies.x._target_={__name__}.Draws", "rasterizer.kernel=0.25", "fit.iterations=1"]
    job.run(composed(*words, "prior=bicubic", "fit.threads=1"), tmp_path)
    names, row = ((tmp_path / "history.csv").read_text().splitlines()[i].split(",") for i in (0, 1))
    assert row[names.index("kernel")] == "0.25"
