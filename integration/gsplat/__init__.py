"""CLEAR in gsplat: one line in its examples/simple_trainer.py, before `cli(main, cfg, verbose=True)`,

    install(Runner, sr="sr_x4")

none (`python -m integration.gsplat --sr sr_x4 simple_trainer.py default --data_dir data`), or two in a loop of your own:

    clear = attach(splats, optimizers, views, conductor, strategy=strategy)
    rasterization = clear.wrap(rasterization)

The names, shapes and order of calls that `attach` relies on are those of gsplat 1.4 (radii [C, N]) and later (radii [C, N, 2]).
"""

from integration.gsplat.attached import Attached, attach
from integration.gsplat.simple_trainer import install

__all__ = ["Attached", "attach", "install"]
