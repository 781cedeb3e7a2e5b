"""What the tests of the 3DGS-style host share."""

from __future__ import annotations

from pathlib import Path

from clear_strategies import Objective
from clear_strategies.schedules import WarmupDecay

FOLDER = Path(__file__).parent / "inria_host"
N = 24  # Gaussians
HR_FROM_START = Objective(lambda_hr=WarmupDecay(start=0, full=1, decay_from=100, end=100))
WITHOUT_HR = Objective(lambda_hr=WarmupDecay(peak=0, final=0))


def options(host, folder, **settings):
    """The options of the host's train.py."""
    opt = host.parser().parse_args(["-s", str(folder)])
    for name, value in settings.items():
        setattr(opt, name, value)
    return opt


def loop(host, clear, opt, gaussians, scene, **settings):
    """The host's loop with its global `render` replaced; the host's own function is back afterwards."""
    own, host.render = host.render, clear.wrap(host.render)
    try:
        host.loop(opt, gaussians, scene, **settings)
    finally:
        host.render = own
