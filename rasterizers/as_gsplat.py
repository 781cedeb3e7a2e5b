"""`rasterization` with the signature of gsplat's, for a loop that was written for gsplat: on a CPU, or on CUDA in its place.

`gsplat_picture` draws what one camera shows, and `gsplat_info` makes the `info`.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any, Final, cast

import torch
from jaxtyping import Float
from torch import Tensor

import rasterizers
from rasterizers.differentiable import stacked
from rasterizers.geometry import depths
from rasterizers.gsplat_info import info_of_all, info_of_visible
from rasterizers.gsplat_picture import CameraView
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, RasterSettings
from rasterizers.modes import in_full_precision, uncompiled
from rasterizers.reference.projection import footprints

__all__ = ["cameras_of", "rasterization", "rasterizer_of"]

_MODES: Final = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_FARTHEST: Final = 1e10  # gsplat's default
_ALPHA_MAX: Final = 0.999  # gsplat's cap on a single contribution; Inria's, and our default, is 0.99
# The only value of each other argument that this package draws; None for one that is not listed. The others change the speed.
_SUPPORTED: Final = {
    "camera_model": "pinhole", "with_ut": False, "with_eval3d": False, "rolling_shutter": "GLOBAL", "distributed": False,
}  # fmt: skip
_WITHOUT_EFFECT: Final = {"channel_chunk", "segmented"}


@uncompiled
@in_full_precision
def rasterization(
    means: Float[Tensor, "*B N 3"],
    quats: Float[Tensor, "*B N 4"],
    scales: Float[Tensor, "*B N 3"],
    opacities: Float[Tensor, "*B N"],
    colors: Float[Tensor, ...],
    viewmats: Float[Tensor, "*B C 4 4"],
    Ks: Float[Tensor, "*B C 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = _FARTHEST,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Float[Tensor, "*B C D"] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    *,
    backend: str = "auto",
    rgb_offset: Float[Tensor, "*B N 3"] | None = None,
    replay: bool = True,
    **more: Any,
) -> tuple[Float[Tensor, "*B C H W X"], Float[Tensor, "*B C H W 1"], dict[str, Any]]:
    """Draw Gaussians as gsplat's `rasterization` does, by a backend of this package: pinhole cameras, any number of channels.

    Args:
        means, quats, scales, opacities: of one scene, or of batches of scenes.
        colors: spherical harmonics [*B, N, K, 3] if `sh_degree`, the active degree, is given; else D channels [*B, N, D] in any
            range. They may differ by camera, [*B, C, N, …].
        backgrounds: the colours behind the images; in [0, 1] if `sh_degree` is given.
        near_plane, far_plane: Gaussians that are not between them are left out.
        radius_clip: Gaussians whose radius is at most this, px, are left out.
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), or both: "RGB+D", "RGB+ED". Depth is that of the
            centres along the camera's axis, the last channel, and has gradients.
        packed: `info` lists the visible Gaussians only, camera by camera. gsplat's default is True. Here it is False, since on a
            CPU the ellipses that it needs take half as long as the image.
        absgrad: after `backward()`, `info["means2d"].absgrad` is the sum over pixels of absolute gradients. Channels that are not
            drawn together are summed apart.
        more: gsplat's other arguments. Those that change only how it computes have no effect.
        backend: a name of `rasterizers.load`.
        rgb_offset: added to the colours before their clamp at 0, with `sh_degree` only; gsplat has no such argument.
        replay: on CUDA with Warp, replay recorded kernels of calls with gradients instead of launching each of them; the result
            is the same bit for bit. With `absgrad`, nothing is replayed.

    Returns:
        images, alphas, and `info`.

        `info` has `means2d` [*B, C, N, 2] (`retain_grad` works), `radii` [*B, C, N, 2] in pixels, `depths`, `conics`,
        `opacities`, `width`, `height`, `n_cameras`, `n_batches` and `tile_size`. `radii`, `depths`, `conics` and `opacities` are
        0 for invisible Gaussians; they are computed when they are read, from the parameters at that time.

        With `packed`, for M visible Gaussians: `means2d` [M, 2], `gaussian_ids`, `camera_ids`, `batch_ids` [M], `radii` [M, 2] in
        pixels, and, with gradients, `depths` [M], `conics` [M, 3] and `opacities` [M], times the factor of
        `rasterize_mode="antialiased"`.

        All arguments get gradients except `Ks`. That of `viewmats` is exact along rigid motions.

    Raises:
        ValueError: a mode or an argument that only gsplat supports, or a wrong shape.
    """
    _require_supported(render_mode, rasterize_mode, more)
    batch, n, cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3] if viewmats.dim() > 2 else 1
    _require_geometry(batch, n, cameras, quats, scales, opacities, viewmats, Ks, rgb_offset)
    if "RGB" in render_mode:
        _require_colors(batch, n, cameras, colors, sh_degree, backgrounds)
    if rgb_offset is not None and sh_degree is None:
        raise ValueError(
            "rgb_offset is an offset of spherical harmonics, give sh_degree; RGB takes it as colors + rgb_offset."
        )
    colors = colors.to(means.dtype)  # gsplat takes float16, too
    by_camera = colors.dim() == len(batch) + 3 + (sh_degree is not None)
    replays = replay and not absgrad and torch.is_grad_enabled()
    rasterizer = _loaded(backend, means.device.type, near_plane, eps2d, rasterize_mode == "antialiased")

    views = []
    batched = (means, quats, scales, opacities, colors, rgb_offset, viewmats, Ks, backgrounds)
    for mu, q, s, opacity, color, offset, poses, K, behind in zip(*(_scenes(x, batch) for x in batched), strict=True):
        for c, camera in enumerate(cameras_of(poses, K, width, height)):
            inputs = Inputs(mu, q, s, opacity, color[c] if by_camera else color, offset)
            inputs = _left_in(inputs, camera, rasterizer, far_plane, radius_clip)
            background = None if behind is None else behind[c]
            views.append(CameraView(rasterizer, camera, poses[c], inputs, sh_degree, background, render_mode, replays))
    learns = viewmats.requires_grad or any(x.requires_grad for v in views for x in v.inputs if x is not None)
    images, alphas, info = _drawn(views, (*batch, cameras), learns, packed, absgrad)
    info |= {"width": width, "height": height, "n_cameras": cameras, "n_batches": batch.numel(), "tile_size": tile_size}
    return images, alphas, info


def _scenes(x: Tensor | None, batch: torch.Size) -> Sequence[Any]:
    """The tensor of each scene. Without a batch it is `x` itself, so that no view comes into the graph."""
    if x is None or not batch:
        return [x] * batch.numel()
    flat = x.reshape(batch.numel(), *x.shape[len(batch) :])
    return [flat[scene] for scene in range(len(flat))]


def _drawn(
    views: Sequence[CameraView], lead: tuple[int, ...], learns: bool, packed: bool, absgrad: bool
) -> tuple[Float[Tensor, "*B C H W X"], Float[Tensor, "*B C H W 1"], dict[str, Any]]:
    """Images, alphas, and what `info` has of each Gaussian.

    Args:
        lead: the dimensions of scenes and cameras, which `views` go through.
        learns: whether a backward pass may follow, and `means2d` is to have a gradient.
    """
    drawn = [view.parts() for view in views]
    each = [parts[0].drawing for parts in drawn]  # the parts of a picture have the same centres
    visible = [drawing.rendering.visible.nonzero()[:, 0] for drawing in each] if packed else []
    info = info_of_visible(each, lead[-1], visible) if packed else info_of_all(each, lead)
    means2d, every = info["means2d"].requires_grad_(learns), [None] * len(views)
    sizes = [len(i) for i in visible] or [len(view.inputs.means) for view in views]
    centres: Sequence[Tensor] = torch.split(means2d.view(-1, 2), sizes)
    absolute: Sequence[Tensor | None] = every
    if absgrad:
        means2d.absgrad = torch.zeros_like(means2d)
        absolute = torch.split(means2d.absgrad.view(-1, 2), sizes)
    of_views = zip(views, drawn, centres, visible or every, absolute, strict=True)
    pictures = [view.picture(parts, u, rows, total) for view, parts, u, rows, total in of_views]
    images, alphas = (stacked(x) for x in zip(*pictures, strict=True))
    return images.view(*lead, *images.shape[1:]), alphas[..., None].view(*lead, *alphas.shape[1:], 1), info


def rasterizer_of(arguments: Mapping[str, Any], backend: str) -> Rasterizer:
    """The rasterizer that draws the colours of a call of gsplat's `rasterization`, over a black background.

    Args:
        arguments: of the call, by name. backend: of `rasterizers.load`.

    Raises:
        ValueError: this package does not draw the same: an argument that only gsplat supports, other colours than spherical
            harmonics of one scene, several cameras.
        BackendUnavailable: the backend is not installed, or has no such device.
    """
    more = {name: value for name, value in arguments.items() if name not in _TAKEN}
    mode, means = arguments.get("rasterize_mode", "classic"), arguments["means"]
    _require_supported("RGB", mode, more)
    sh_degree, cameras = arguments.get("sh_degree"), len(arguments["viewmats"])
    if (
        sh_degree is None
        or means.dim() != 2
        or arguments["colors"].dim() != 3
        or means.dtype != torch.float32
        or cameras != 1
    ):
        raise ValueError("only one view of float32 Gaussians of one scene with spherical harmonics is drawn.")
    if arguments.get("far_plane", _FARTHEST) < _FARTHEST or arguments.get("radius_clip", 0.0) > 0:
        raise ValueError("far_plane and radius_clip leave Gaussians out.")
    near, eps2d = arguments.get("near_plane", 0.01), arguments.get("eps2d", 0.3)
    return _loaded(backend, means.device.type, near, eps2d, mode == "antialiased")


_TAKEN: Final = inspect.signature(rasterization).parameters


def cameras_of(viewmats: Float[Tensor, "C 4 4"], Ks: Float[Tensor, "C 3 3"], width: int, height: int) -> list[Camera]:
    """Gsplat's cameras. Equal ones are the same object, whose numbers a backend then has on the device."""
    poses = zip(viewmats.detach().tolist(), Ks.detach().tolist(), strict=True)
    return [_camera(tuple(map(tuple, pose)), viewmats.dtype, *K[0][::2], *K[1][1:], width, height) for pose, K in poses]


@functools.lru_cache(maxsize=1024)
@torch.inference_mode(False)  # or the camera of an evaluation could not be trained by
def _camera(
    pose: tuple[tuple[float, ...], ...], dtype: torch.dtype, fx: float, cx: float, fy: float, cy: float, width: int, height: int
) -> Camera:  # fmt: skip
    return Camera(torch.tensor(pose, dtype=dtype, device="cpu"), fx, fy, cx, cy, width, height)


def _left_in(inputs: Inputs, camera: Camera, rasterizer: Rasterizer, far_plane: float, radius_clip: float) -> Inputs:
    """The inputs with opacity 0 for Gaussians that are too far or too small."""
    if far_plane >= _FARTHEST and radius_clip <= 0:
        return inputs
    settings = cast(RasterSettings, rasterizer)
    with torch.no_grad():
        keep = depths(inputs.means, camera.world_to_camera.to(inputs.means)) <= far_plane
        if radius_clip > 0:
            f = footprints(inputs.means, inputs.quats, inputs.scales, camera, settings.kernel)
            opacities = inputs.opacities * f.compensation if settings.antialiased else inputs.opacities
            radii = f.radii(opacities, 1 / 255)  # NaN of those behind the camera, which are not drawn
            keep &= ~(radii <= radius_clip).all(-1)
    return inputs._replace(opacities=inputs.opacities * keep)


def _require_geometry(
    batch: tuple[int, ...], n: int, cameras: int, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    rgb_offset: Tensor | None,
) -> None:  # fmt: skip
    """Raise a ValueError for a tensor of another shape than gsplat asks for."""
    each = {
        "quats": (quats, (*batch, n, 4)), "scales": (scales, (*batch, n, 3)), "opacities": (opacities, (*batch, n)),
        "viewmats": (viewmats, (*batch, cameras, 4, 4)), "Ks": (Ks, (*batch, cameras, 3, 3)),
        "rgb_offset": (rgb_offset, (*batch, n, 3)),
    }  # fmt: skip
    for name, (value, shape) in each.items():
        if value is not None and value.shape != shape:
            raise ValueError(f"{name} must have the shape {list(shape)}, got {list(value.shape)}.")
    if 0 in (*batch, cameras):
        raise ValueError(f"at least one scene and one camera must be given, got viewmats {list(viewmats.shape)}.")


def _require_colors(
    batch: tuple[int, ...], n: int, cameras: int, colors: Tensor, sh_degree: int | None, backgrounds: Tensor | None
) -> None:
    """The same of the colours, which are of all cameras or of each, and of what is behind them."""
    if sh_degree is not None and sh_degree not in range(4):
        raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {sh_degree!r}.")
    bands = None if sh_degree is None else (sh_degree + 1) ** 2
    fits = colors.shape[: -1 if bands is None else -2] in ((*batch, n), (*batch, cameras, n))
    if not fits or not colors.shape[-1] or (bands is not None and (colors.shape[-1] != 3 or colors.shape[-2] < bands)):
        last = "D] with D >= 1" if bands is None else f"K, 3] with K >= {bands}"
        raise ValueError(
            f"colors{'' if sh_degree is None else f' with sh_degree={sh_degree}'} must have the shape "
            f"[{', '.join(map(str, (*batch, n)))}, {last}, or that of each camera, got {list(colors.shape)}."
        )
    channels = 3 if bands is not None else colors.shape[-1]
    if backgrounds is not None and backgrounds.shape != (*batch, cameras, channels):
        raise ValueError(
            f"backgrounds must have the shape {[*batch, cameras, channels]}, got {list(backgrounds.shape)}."
        )


def _require_supported(render_mode: str, rasterize_mode: str, more: Mapping[str, Any]) -> None:
    refused = []
    for name in more.keys() - _WITHOUT_EFFECT:
        value, supported = more[name], _SUPPORTED.get(name)
        value = value.name if isinstance(value, Enum) else value
        if value is not supported and not (isinstance(value, str | bool) and value == supported):
            refused.append(f"{name}={value!r}" if isinstance(value, str | bool | int | float) else name)
    if refused:
        raise ValueError(
            f"rasterizers.rasterization does not support {', '.join(sorted(refused))}. gsplat's own does, on CUDA."
        )
    if render_mode not in _MODES or rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(
            f"render_mode must be one of {', '.join(_MODES)}, and rasterize_mode classic or antialiased, got {render_mode!r} and "
            f"{rasterize_mode!r}."
        )


@functools.lru_cache(maxsize=8)
def _loaded(name: str, device: str, near: float, kernel: float, antialiased: bool) -> Rasterizer:
    name = rasterizers.fastest(device) if name == "auto" else name
    where = rasterizers.for_device(name, device)
    return rasterizers.load(name, near=near, kernel=kernel, antialiased=antialiased, alpha_max=_ALPHA_MAX, **where)
