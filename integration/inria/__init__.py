"""CLEAR in the `train.py` of Inria's 3DGS and of its forks: two lines after `gaussians.training_setup(opt)`,

    clear = attach(gaussians, scene.getTrainCameras(), conductor("clear", iterations=opt.iterations), sr="sr_x4",
                   threshold=opt.densify_grad_threshold, densify_until=opt.densify_until_iter)
    render = clear.wrap(render)

or none:

    python -m integration.inria --sr sr_x4 train.py -s data

Only names that all these repositories share are used, and only their own train.py imports them.
"""

from integration.inria.attached import THRESHOLD, Attached, Render, attach

__all__ = ["THRESHOLD", "Attached", "Render", "attach"]
