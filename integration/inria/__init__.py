"""CLEAR in the `train.py` of Inria's 3DGS and of its forks: one line after `gaussians.training_setup(opt)`,

    install(gaussians, scene, opt, sr="sr_x4")

or none:

    python -m integration.inria --sr sr_x4 train.py -s data

Only names that all these repositories share are used, and only their own train.py imports them.
"""

from integration.inria.attached import Attached, attach
from integration.inria.from_options import install

__all__ = ["Attached", "attach", "install"]
