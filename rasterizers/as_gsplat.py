"""`rasterization` with the signature of gsplat's, for a loop that was written for gsplat: on a CPU, or on CUDA in its place.

A picture is drawn three channels at a time. The first three are the spherical harmonics, or the first of the colours; every other
channel is a number of each Gaussian. Depth is drawn with the first three, or, by a backend without the trait `depth_gradient`, as
two more channels: the depth of the centre, and the 1 whose picture is alpha.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

import rasterizers
from rasterizers.autograd import Rendered, in_graph, render
from rasterizers.geometry import REACH, constant_band, depths, low_and_span
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, RasterSettings, WithRadii, over
from rasterizers.modes import in_full_precision, uncompiled
from rasterizers.native import empty_for
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
        means, quats, scales, opacities: of batches of scenes, or of one.
        colors: with `sh_degree`, the active degree, spherical harmonics [*B, N, K, 3]; without it D channels [*B, N, D] in any
            range. Either may be of each camera, [*B, C, N, …].
        backgrounds: behind the image; with `sh_degree` each is a colour in [0, 1].
        near_plane, far_plane: Gaussians beyond them are left out, and those whose radius is at most `radius_clip` px.
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), or both: "RGB+D", "RGB+ED". Depth is that of the
            centres along the camera's axis, the last channel, and has gradients.
        packed: `info` is that of the visible Gaussians of each camera, one after the other. gsplat's default is True, and here
            False, since on a CPU its ellipses take half as long as the image.
        absgrad: after `backward()`, `info["means2d"].absgrad` is the sum over pixels of absolute gradients. Those of channels
            that are not drawn together are summed apart.
        more: gsplat's other arguments. Those that change only how it computes have no effect.
        backend: a name of `rasterizers.load`.
        rgb_offset: added to the colours before their clamp at 0, with `sh_degree` only; gsplat has no such argument.
        replay: on CUDA with Warp, replay the kernels of drawings with gradients in place of launching each of them. The bits are
            the same, but with `absgrad` nothing is replayed.

    Returns:
        images, alphas, and `info`: `means2d` [*B, C, N, 2] (`retain_grad` works); `radii` [*B, C, N, 2] in pixels, `depths`,
        `conics` and `opacities` of the visible, 0 of others, made when they are asked for, of the parameters as they are then;
        and `width`, `height`, `n_cameras`, `n_batches`, `tile_size`. Packed, of M visible Gaussians: `means2d` [M, 2],
        `gaussian_ids`, `camera_ids` and `batch_ids` [M], and in the graph of what they depend on, `depths` [M], `conics` [M, 3]
        and `opacities` [M], times the factor of `rasterize_mode="antialiased"`; `radii` [M, 2] in pixels.

        Gradients reach everything that is given but `Ks`. That of `viewmats` is exact along rigid motions.

    Raises:
        ValueError: a mode or an argument that only gsplat supports, or a wrong shape.
    """
    _require_supported(render_mode, rasterize_mode, more)
    batch, cameras = means.shape[:-2], viewmats.shape[-3]
    replays = replay and not absgrad and torch.is_grad_enabled()
    n_scenes = batch.numel()
    shape = _Shape(batch, means.shape[-2], cameras, sh_degree, "RGB" in render_mode)
    shape.require(quats, scales, opacities, colors, viewmats, Ks, backgrounds, rgb_offset)
    if rgb_offset is not None and sh_degree is None:
        raise ValueError(
            "rgb_offset is an offset of spherical harmonics, give sh_degree; RGB takes it as colors + rgb_offset."
        )
    colors = colors.to(means.dtype)  # gsplat takes float16, too
    rasterizer = _loaded(backend, means.device.type, near_plane, eps2d, rasterize_mode == "antialiased")

    def of_scene(x: Tensor, scene: int) -> Tensor:
        return x if not batch else x.reshape(n_scenes, *x.shape[len(batch) :])[scene]

    by_camera = colors.dim() == len(batch) + 3 + (sh_degree is not None)
    views = []
    for scene in range(n_scenes):
        poses, K = of_scene(viewmats, scene), of_scene(Ks, scene)
        own, behind = of_scene(colors, scene), None if backgrounds is None else of_scene(backgrounds, scene)
        mu, q, s, opacity = (of_scene(x, scene) for x in (means, quats, scales, opacities))
        offset = None if rgb_offset is None else of_scene(rgb_offset, scene)
        for c, camera in enumerate(cameras_of(poses, K, width, height)):
            left_in = _left_in(mu, q, s, opacity, camera, far_plane, radius_clip, eps2d)
            inputs = Inputs(mu, q, s, left_in, own[c] if by_camera else own, offset)
            views.append(
                _View(
                    rasterizer, camera, poses[c], inputs, sh_degree,
                    None if behind is None else behind[c], render_mode, replays,
                )
            )  # fmt: skip
    drawn = [view.parts() for view in views]
    each = [parts[0].rendered for parts in drawn]
    rows: Sequence[Tensor | None]
    if packed:
        info, centres, rows = _packed_info(each, [view.inputs for view in views], cameras)
    else:
        info, centres, rows = _info(each, views, (*batch, cameras))
    if absgrad:
        info["means2d"].absgrad = torch.zeros_like(info["means2d"])
    info |= {"width": width, "height": height, "n_cameras": cameras, "n_batches": n_scenes, "tile_size": tile_size}
    absolute: Sequence[Tensor | None] = _like_centres(info["means2d"], centres) if absgrad else [None] * len(views)
    pictures = [
        view.picture(parts, u, i, a) for view, parts, u, i, a in zip(views, drawn, centres, rows, absolute, strict=True)
    ]
    images, alphas = _stacked([image for image, _ in pictures]), _stacked([alpha for _, alpha in pictures])
    lead = (*batch, cameras)
    return images.view(*lead, *images.shape[1:]), alphas[..., None].view(*lead, *alphas.shape[1:], 1), info


@dataclass(frozen=True, slots=True)
class _Part:
    """Three channels: a picture of low + span · what was drawn.

    Args:
        keeps: how many of the three are wanted.
    """

    rendered: Rendered
    inputs: Inputs
    low: float
    span: float
    keeps: int


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One camera's picture."""

    rasterizer: Rasterizer
    camera: Camera
    pose: Float[Tensor, "4 4"]
    inputs: Inputs
    sh_degree: int | None
    background: Float[Tensor, " D"] | None
    render_mode: str
    replays: bool

    def parts(self) -> list[_Part]:
        found: list[_Part] = []
        means, wants_depth = self.inputs.means, self.render_mode != "RGB"
        depth = wants_depth and self.rasterizer.traits.depth_gradient  # with the first of the parts
        if "RGB" in self.render_mode and self.sh_degree is not None:
            behind = [0.0] * 3 if self.background is None else self.background.tolist()
            rasterizer, bands = over(self.rasterizer, cast(Any, tuple(behind))), (self.sh_degree + 1) ** 2
            rendered = render(rasterizer, self.inputs, bands, self.camera, depth=depth, replays=self.replays)
            found.append(_Part(rendered, self.inputs, 0.0, 1.0, 3))
        elif "RGB" in self.render_mode:
            for three in self._threes():
                found.append(self._channels(*three, depth=depth and not found))
        elif depth:
            found.append(self._channels(torch.zeros_like(means), None, 0, depth=True))
        if wants_depth and not depth:
            z = depths(means, self.pose.to(means)).clamp_min(0)  # behind the camera nothing is drawn
            found.append(self._channels(torch.stack((z, torch.ones_like(z), torch.zeros_like(z)), 1), None, 2))
        return found

    def picture(
        self, parts: Sequence[_Part], means2d: Tensor, rows: Int[Tensor, " M"] | None, absgrad: Tensor | None
    ) -> tuple[Float[Tensor, "H W X"], Float[Tensor, "H W"]]:
        """The picture, and its alpha."""
        pictures = []
        alpha: Tensor | None = None
        depth: Tensor | None = None
        for part in parts:
            drawn = in_graph(part.rendered, part.inputs, means2d, rows, pose=self.pose, absgrad=absgrad)
            alpha, depth = (drawn.alpha, drawn.depth) if alpha is None else (alpha, depth)
            image = drawn.image if (part.low, part.span) == (0.0, 1.0) else part.low + part.span * drawn.image
            pictures.append(image if part.keeps == 3 else image[..., : part.keeps])
        if self.render_mode != "RGB":
            if depth is None:
                accumulated, alpha = pictures.pop().unbind(-1)  # with exact gradients
                depth = accumulated / alpha.clamp_min(1e-10)
            pictures.append((depth if "ED" in self.render_mode else depth * cast(Tensor, alpha))[..., None])
        image = pictures[0] if len(pictures) == 1 else torch.cat(pictures, -1)
        if (
            self.background is not None
            and self.background.requires_grad
            and "RGB" in self.render_mode
            and alpha is not None
        ):
            through = (1 - alpha.detach())[..., None] * (
                self.background - self.background.detach()
            )  # 0, for its gradient
            image = image + torch.nn.functional.pad(through, (0, image.shape[-1] - through.shape[-1]))
        return image, cast(Tensor, alpha)

    def _threes(self) -> Iterator[tuple[Tensor, Tensor | None, int]]:
        """The channels by threes, the background of each three, and how many of them there are."""
        for first in range(0, self.inputs.colors.shape[-1], 3):
            three = self.inputs.colors[:, first : first + 3]
            behind = None if self.background is None else self.background.detach()[first : first + 3]
            keeps = three.shape[1]
            yield torch.nn.functional.pad(three, (0, 3 - keeps)), behind, keeps

    def _channels(
        self, colors: Float[Tensor, "N 3"], background: Tensor | None, keeps: int, *, depth: bool = False
    ) -> _Part:
        behind = [0.0] * 3 if background is None else [*background.tolist(), *[0.0] * (3 - len(background))]
        low, span = low_and_span(colors, behind)
        inputs = self.inputs._replace(colors=constant_band((colors - low) / span), rgb_offset=None)
        behind = [(x - low) / span for x in behind]
        rasterizer = over(self.rasterizer, cast(Any, tuple(behind)))
        rendered = render(rasterizer, inputs, 1, self.camera, depth=depth, replays=self.replays)
        return _Part(rendered, inputs, low, span, keeps)


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
def _camera(
    pose: tuple[tuple[float, ...], ...], dtype: torch.dtype, fx: float, cx: float, fy: float, cy: float, width: int, height: int
) -> Camera:  # fmt: skip
    return Camera(torch.tensor(pose, dtype=dtype, device="cpu"), fx, fy, cx, cy, width, height)


def _left_in(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, camera: Camera, far_plane: float, radius_clip: float,
    kernel: float,
) -> Float[Tensor, " N"]:  # fmt: skip
    """The opacities, 0 for what is too far or too small."""
    if far_plane >= _FARTHEST and radius_clip <= 0:
        return opacities
    with torch.no_grad():
        keep = depths(means, camera.world_to_camera.to(means)) <= far_plane
        if radius_clip > 0:
            f = footprints(means, quats, scales, camera, kernel)
            radii = _extents(opacities, f.deviations, 1 / 255)
            keep &= ~(radii <= radius_clip).all(-1)  # NaN, of those behind the camera, which are not drawn
    return opacities * keep


def _extents(
    opacities: Float[Tensor, " M"], deviations: Float[Tensor, "M 2"], alpha_min: float
) -> Float[Tensor, "M 2"]:
    """Half the box in which alpha may reach alpha_min, whole px."""
    reach = (2 * (opacities / alpha_min).log()).clamp_min(0).sqrt().clamp_max(REACH)
    return (reach[:, None] * deviations).ceil().clamp_min(1)


class _Info(dict[str, Any]):
    """Gsplat's `info`. What not every loop reads is made when it is asked for, also by what goes through all of it.

    Args:
        later: what makes each of these values, and no other.
    """

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], dict[str, Any]]]) -> None:
        super().__init__(values)
        self._later = later

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or name in self._later

    def __missing__(self, name: str) -> Any:
        if name not in self._later:
            raise KeyError(name)
        for made, value in self._later[name]().items():
            self.setdefault(made, value)  # what the loop has written stays
        return self[name]

    def __iter__(self) -> Iterator[str]:
        # Names make nothing: a type checker asks for one.
        return iter(dict.fromkeys((*super().__iter__(), *self._later)))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    get, keys, values, items = Mapping.get, Mapping.keys, Mapping.values, Mapping.items  # type: ignore[assignment]

    def copy(self) -> dict[str, Any]:
        return dict(self)

    def __or__(self, other: dict[str, Any]) -> dict[str, Any]:  # type: ignore[override]
        return self.copy() | other


def _info(
    each: Sequence[Rendered], views: Sequence[_View], lead: tuple[int, ...]
) -> tuple[dict[str, Any], Sequence[Tensor], Sequence[None]]:
    """What gsplat's strategies read, and the centres of each image."""
    means2d = _stacked([rendering.means2d for rendering, *_ in each])
    means2d = means2d.clone() if len(each) == 1 else means2d
    means2d = means2d.view(*lead, *means2d.shape[1:]).requires_grad_()

    def radii() -> dict[str, Tensor]:
        found = _stacked([cast(WithRadii, rendering).radii for rendering, *_ in each])
        return {"radii": found.view(*lead, *found.shape[1:])}

    def ellipses() -> dict[str, Tensor]:
        found: dict[str, list[Tensor]] = {name: [] for name in of_ellipses}
        for rendered, view in zip(each, views, strict=True):
            rows = rendered.rendering.visible.nonzero()[:, 0]
            for name, values in _columns(rendered, view.inputs, rows).items():
                if name in found:
                    whole = values.new_zeros(len(view.inputs.means), *values.shape[1:])
                    found[name].append(whole.index_copy(0, rows, values))
        return {name: torch.stack(x).view(*lead, *x[0].shape) for name, x in found.items()}

    flat = means2d.view(len(each), *means2d.shape[len(lead) :])
    values = {"means2d": means2d, "gaussian_ids": None, "camera_ids": None, "batch_ids": None}
    own_radii = all(rasterizer.traits.radii for _, rasterizer, *_ in each)
    of_ellipses = ("depths", "conics", "opacities", *(() if own_radii else ("radii",)))
    later = {"radii": radii, **dict.fromkeys(of_ellipses, ellipses)}
    return _Info(values, later), flat.unbind(), [None] * len(each)


def _packed_info(
    each: Sequence[Rendered], splats: Sequence[Inputs], cameras: int
) -> tuple[dict[str, Any], Sequence[Tensor], Sequence[Tensor]]:
    """The same of the visible alone, and which these are."""
    rows = [rendering.visible.nonzero()[:, 0] for rendering, *_ in each]
    columns = [_columns(*x) for x in zip(each, splats, rows, strict=True)]
    info: dict[str, Any] = {name: torch.cat([x[name] for x in columns]) for name in columns[0]}
    info["means2d"].requires_grad_()
    ids = torch.cat(rows)
    view = torch.cat([torch.full_like(i, k) for k, i in enumerate(rows)])
    info |= {"gaussian_ids": ids, "camera_ids": view % cameras, "batch_ids": view // cameras}
    return info, torch.split(info["means2d"], [len(i) for i in rows]), rows


@in_full_precision
def _columns(rendered: Rendered, splats: Inputs, rows: Int[Tensor, " M"]) -> dict[str, Tensor]:
    """What gsplat says of the visible Gaussians."""
    settings = cast(RasterSettings, rendered.rasterizer)  # `over` has checked it
    f = footprints(splats.means[rows], splats.quats[rows], splats.scales[rows], rendered.camera, settings.kernel)
    opacities = splats.opacities[rows] * f.compensation if settings.antialiased else splats.opacities[rows]
    with torch.no_grad():  # where alpha falls below what is drawn
        radii = _extents(opacities, f.deviations, settings.alpha_min).int()
    means2d = rendered.rendering.means2d[rows]
    return {"means2d": means2d, "radii": radii, "depths": f.depths, "conics": f.conics, "opacities": opacities}


def _like_centres(means2d: Tensor, centres: Sequence[Tensor]) -> list[Tensor]:
    """The rows of `means2d.absgrad` that belong to each of the centres."""
    absgrad: Tensor = means2d.absgrad  # type: ignore[attr-defined]
    return list(torch.split(absgrad.view(-1, 2), [len(x) for x in centres]))


def _stacked(tensors: Sequence[Tensor]) -> Tensor:
    """One tensor of all; a single one is not copied."""
    stacked: Tensor = tensors[0][None] if len(tensors) == 1 else _Stack.apply(*tensors)  # type: ignore[no-untyped-call]
    return stacked


class _Stack(torch.autograd.Function):
    """`torch.stack`, to memory that is used again: fresh pages of eight images cost a tenth of drawing them."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        return torch.stack(tensors, out=empty_for(tensors[0], (len(tensors), *tensors[0].shape)))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        return gradient.unbind()


@dataclass(frozen=True, slots=True)
class _Shape:
    """What gsplat asks of the shapes: batch dimensions, Gaussians and cameras."""

    batch: tuple[int, ...]
    n: int
    cameras: int
    sh_degree: int | None
    draws_colors: bool

    def require(
        self, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
        backgrounds: Tensor | None, rgb_offset: Tensor | None,
    ) -> None:  # fmt: skip
        """Raise a ValueError for a tensor of another shape."""
        b, n, c = self.batch, self.n, self.cameras
        each = {
            "quats": (quats, (*b, n, 4)), "scales": (scales, (*b, n, 3)), "opacities": (opacities, (*b, n)),
            "viewmats": (viewmats, (*b, c, 4, 4)), "Ks": (Ks, (*b, c, 3, 3)), "rgb_offset": (rgb_offset, (*b, n, 3)),
        }  # fmt: skip
        for name, (value, shape) in each.items():
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} must have the shape {list(shape)}, got {list(value.shape)}.")
        if not self.draws_colors:
            return
        if not any(self._fits(colors, lead) for lead in ((*b, n), (*b, c, n))):
            last = "D]" if self.sh_degree is None else f"K, 3] with K >= {(self.sh_degree + 1) ** 2}"
            raise ValueError(
                f"colors{'' if self.sh_degree is None else f' with sh_degree={self.sh_degree}'} must have the shape "
                f"[{', '.join(map(str, (*b, n)))}, {last}, or that of each camera, got {list(colors.shape)}."
            )
        channels = 3 if self.sh_degree is not None else colors.shape[-1]
        if backgrounds is not None and backgrounds.shape != (*b, c, channels):
            raise ValueError(f"backgrounds must have the shape {[*b, c, channels]}, got {list(backgrounds.shape)}.")

    def _fits(self, colors: Tensor, lead: tuple[int, ...]) -> bool:
        if self.sh_degree is None:
            return colors.shape[:-1] == lead
        return colors.shape[:-2] == lead and colors.shape[-1] == 3 and colors.shape[-2] >= (self.sh_degree + 1) ** 2


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
