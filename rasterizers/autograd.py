"""Rasterizers as differentiable torch functions.

`draw` returns a rendering that is part of the autograd graph; `as_gsplat.rasterization` does so with gsplat's signature. A
backward pass handles one cotangent; `Rendering.vjp` handles several, for which callers of code that draws have
`collected_drawings`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.ahead import drawing_ahead
from rasterizers.as_gsplat import rasterization
from rasterizers.differentiable import Drawing, Drawn, collected_drawings, in_graph, render
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, Splats
from rasterizers.modes import in_full_precision, uncompiled

__all__ = ["Drawing", "Drawn", "collected_drawings", "draw", "drawing_ahead", "rasterization"]


@uncompiled
@in_full_precision
def draw(
    rasterizer: Rasterizer,
    splats: Splats,
    camera: Camera,
    means2d: Tensor | None = None,
    *,
    depth: bool = False,
    colors: Float[Tensor, "N K 3"] | None = None,
) -> Drawn:
    """Draw the splats. Gradients flow from the image, its alpha and its depth to the splats' tensors and the pose.

    Without the trait `depth_gradient`, depth has none, and a loss of alpha draws the splats a second time, over another
    background, and takes a second backward pass.

    Args:
        means2d: a tensor that receives the projected centres and whose `.grad` will be the screen gradient; None makes one.
        depth: also draw the expected depth.
        colors: the tensor of which `splats.sh0` and `splats.shN` are slices, if the caller has one.

    Raises:
        ValueError: the rasterizer lacks the trait `depth` that `depth=True` needs.
        NotImplementedError: in `backward`, if the loss depends on the depth and the rasterizer lacks `depth_gradient`.
        RuntimeError: in `backward`, if the loss depends on these gradients, e.g. by a gradient penalty.
    """
    if colors is None:
        colors = torch.cat((splats.sh0, splats.shN), 1)
    inputs = Inputs(splats.means, splats.quats, splats.scales, splats.opacities, colors, splats.rgb_offset)
    drawing = render(rasterizer, inputs, 1 + splats.shN.shape[1], camera, depth=depth)
    if means2d is None:
        means2d = drawing.rendering.means2d.clone().requires_grad_()
    else:
        means2d.data.copy_(drawing.rendering.means2d)
    return in_graph(drawing, means2d, pose=camera.world_to_camera)
