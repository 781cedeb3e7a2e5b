"""The trainer's own hot loops: image losses with their gradients.

`torch` is the specification, in float64 inside; faster backends agree with it.
"""

from clear_strategies.kernels.torch import LossAndGradient, haar_l1, l1, ssim

__all__ = ["LossAndGradient", "haar_l1", "l1", "ssim"]
