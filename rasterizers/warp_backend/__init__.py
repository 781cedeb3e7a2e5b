"""The backend "warp": NVIDIA Warp kernels, compiled at first use from one source for CUDA and for the CPU, in float32.

The stages have the names of `rasterizers.reference`: project, bin, blend, and their VJPs. `rasterizer` holds the settings
and imports Warp only when it is constructed; `frame` launches the kernels; the other files hold the kernels, with VJPs
written by hand.

Deterministic: every sum has a fixed order, and there are no floating-point atomics.
"""

from rasterizers.warp_backend.rasterizer import WarpRasterizer as WarpRasterizer
