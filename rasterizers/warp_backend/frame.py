"""A frame: one set of Gaussians seen from one pose on one or more screens. Runs the kernels and keeps what they share.

    project (each screen) -> order by depth -> (each screen: list pairs -> blend)          and back: blend_vjp -> pull

Memory is torch's (but the sort's scratch), and all work goes to torch's current stream. Nothing here waits for the device
but for how many pairs of Gaussian and tile there are, and that while the depths are being sorted.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from rasterizers.checks import packed_rows, require_cotangents, require_finite, require_tiles, shares
from rasterizers.interface import Camera, RasterSettings, Rendering, SplatGradients, Splats, Traits
from rasterizers.warp_backend import types
from rasterizers.warp_backend.bins import find_tiles, list_pairs
from rasterizers.warp_backend.blend import blend, blend_vjp
from rasterizers.warp_backend.colour import basis
from rasterizers.warp_backend.launch import array as _array
from rasterizers.warp_backend.launch import on_stream
from rasterizers.warp_backend.project import project, pull

_TILE: Final = int(types.TILE)
_PIXELS: Final = int(types.PIXELS)
_ROW: Final = 14
_MARGIN: Final = 0.3  # share of the half field of view beyond the image up to which the Jacobian follows
_PAIR_BYTES: Final = 24  # tile and place, twice for the sort, and the Gaussian, before and after it
_SENT_BYTES: Final = 36  # what a pair sends back for one cotangent
_LANES: Final = {"cuda": 32, "cpu": 1}  # threads a tile on the way back: a warp; on a CPU Warp's blocks have one


@dataclass(frozen=True, slots=True)
class WarpRasterizer(RasterSettings):
    """Warp kernels for CUDA; on a CPU the same kernels, to check them.

    Args:
        tile: edge of the demand mask's tiles, px, a multiple of 8; a tile not asked for is not even listed.
        memory: MiB that the lists of one picture may take, and what its pairs send back.
        device: "cuda" or "cpu", where the splats' tensors lie.

    A rendering's `vjp` reads the splats' tensors again: pull before they are changed in place.
    """

    memory: int = 4096
    device: str = "cpu"

    def __post_init__(self) -> None:
        RasterSettings.__post_init__(self)
        if self.tile % _TILE:
            raise ValueError(f"tile must be a multiple of {_TILE} pixels, got {self.tile}.")
        if self.memory < 1:
            raise ValueError(f"memory must be at least 1 MiB, got {self.memory}.")

    @property
    def traits(self) -> Traits:
        return Traits(
            devices=frozenset({self.device}),
            dtypes=frozenset({torch.float32}),
            shared_pass=True,
            shared_scales=True,
            deterministic=True,
        )

    def __call__(self, splats: Splats, camera: Camera, tiles: Bool[Tensor, "th tw"] | None = None) -> Rendering:
        return _Frame(self, [(splats, camera)], [tiles]).draw()[0]

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], tiles: Sequence[Bool[Tensor, "_ _"] | None] | None = None
    ) -> list[Rendering]:
        """Screens of one pose share colour and depth order where their tensors are the same objects."""
        masks = [None] * len(jobs) if tiles is None else tiles
        if len(jobs) > 1 and all(shares(jobs[0], job) for job in jobs[1:]):
            return _Frame(self, jobs, masks).draw()
        return [self(splats, camera, mask) for (splats, camera), mask in zip(jobs, masks, strict=True)]


class _Screen:
    """What differs between the screens of a frame."""

    def __init__(self, settings: WarpRasterizer, splats: Splats, camera: Camera, mask: Tensor | None) -> None:
        n, like = len(splats), splats.means
        self.camera = camera
        self.columns, self.rows_of_tiles = -(-camera.width // _TILE), -(-camera.height // _TILE)
        self.opacities = splats.opacities.detach().contiguous()
        self.offsets = None if splats.rgb_offset is None else splats.rgb_offset.detach().contiguous()
        self.wanted = None if mask is None else _tiles_of(mask, camera, settings.tile).to(like.device)
        self.struct = _screen_struct(camera, self.columns, self.rows_of_tiles)
        self.ellipses = like.new_empty(n, _ROW)
        self.means2d = like.new_empty(n, 2)
        self.visible = like.new_empty(n, dtype=torch.bool)
        self.counts = like.new_empty(n, dtype=torch.int32)  # tiles that list each Gaussian …
        self.firsts = like.new_empty(n, dtype=torch.int32)  # … and its first pair
        self.lists: _Lists  # once they are sorted


@dataclass(frozen=True, slots=True, eq=False)
class _Lists:
    """Pairs of Gaussian and tile: the Gaussians tile by tile, and each pair's place among those of its Gaussian."""

    count: int
    gaussians: Tensor
    places: Tensor
    starts: Tensor
    ends: Tensor


class _Frame:
    """One depth order for several screens, and the tensors that are read again on the way back."""

    def __init__(
        self,
        settings: WarpRasterizer,
        jobs: Sequence[tuple[Splats, Camera]],
        tiles: Sequence[Bool[Tensor, "_ _"] | None],
    ) -> None:
        splats, camera = jobs[0]
        for mask, (_, screen) in zip(tiles, jobs, strict=True):
            if mask is not None:
                require_tiles(mask, screen.width, screen.height, settings.tile)
        like = splats.means
        if like.dtype != torch.float32 or like.device.type != settings.device:
            raise TypeError(
                f"this warp rasterizer draws float32 on {settings.device}, got {like.dtype} on {like.device}. "
                "Move the splats there, or load it with another device."
            )
        self.settings, self.jobs, self.n, self.like = settings, jobs, len(splats), like.detach()
        self.pose, self.cuts = _pose_struct(camera), _cuts_struct(settings)
        self.means, self.quats, self.scales = (
            x.detach().contiguous() for x in (splats.means, splats.quats, splats.scales)
        )
        self.sh0, self.shN = splats.sh0.detach()[:, 0], packed_rows(splats.shN.detach())
        self.bands = self.shN.shape[1]
        self.colours = self.empty(self.n, 3)
        self.slopes = self.empty(self.n if self.bands else 0, 3, 3)
        self.screens = [_Screen(settings, job, screen, mask) for (job, screen), mask in zip(jobs, tiles, strict=True)]
        self._basis: Tensor | None = None

    def draw(self) -> list[Rendering]:
        """A picture on each screen.

        Raises:
            ValueError: a number is not finite.
            MemoryError: the lists of a picture would pass the budget.
        """
        with on_stream(self.like.device):
            keys, totals = self._project()
            order = _sorted(keys, torch.arange(2 * self.n, dtype=torch.int32, device=self.like.device), self.n, 31)[1]
            *pairs, poison = totals()
            if poison:
                for splats, _ in self.jobs:
                    require_finite(splats)
            for screen, count in zip(self.screens, pairs, strict=True):
                self._require_memory(screen, count)
                screen.lists = self._list(screen, order, count)
            return [WarpRendering(self, screen) for screen in self.screens]

    def launch(self, kernel: Any, threads: int, *arguments: Any) -> None:
        """A thread per Gaussian, pair or pixel; the arguments are the kernel's."""
        wp.launch(kernel, threads, inputs=arguments, device=wp.device_from_torch(self.like.device))

    def empty(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return self.like.new_empty(shape, dtype=dtype)

    def basis(self) -> Float[Tensor, "N B1"]:
        """Y of this pose's directions, the same for all screens; made when first asked for."""
        if self._basis is None:
            visible = torch.stack([screen.visible for screen in self.screens]).any(0)
            self._basis = self.like.new_zeros(self.n, self.bands + 1)
            arguments = (self.pose, _array(self.means, wp.vec3), _array(visible), _array(self._basis))
            self.launch(basis, self.n, *arguments)
        return self._basis

    def _project(self) -> tuple[Tensor, Any]:
        """Depth keys, with room for sorting them, and a function that waits for [pairs of each screen, poison]."""
        keys = self.empty(2 * self.n, dtype=torch.int32)
        poison = self.like.new_zeros(1, dtype=torch.int64)
        for nth, screen in enumerate(self.screens):
            self.launch(
                project, self.n, self.pose, screen.struct, self.cuts,
                _array(self.means, wp.vec3), _array(self.quats, wp.vec4), _array(self.scales, wp.vec3),
                _array(screen.opacities), _array(self.sh0, wp.vec3), _array(self.shN, wp.vec3),
                screen.offsets is not None, _array(screen.offsets, wp.vec3),
                screen.wanted is not None, _array(screen.wanted), nth == 0,
                _array(keys), _array(self.colours, wp.vec3), _array(self.slopes, wp.mat33),
                _array(screen.ellipses, types.Row), _array(screen.means2d, wp.vec2), _array(screen.visible),
                _array(screen.counts), _array(poison),
            )  # fmt: skip
        return keys, _read_later(torch.cat([*(screen.counts.sum(0, True) for screen in self.screens), poison]))

    def _require_memory(self, screen: _Screen, count: int) -> None:
        """Counts are 64-bit until here, where they are found to fit."""
        mebibytes = _room(count) * (_PAIR_BYTES + _SENT_BYTES) >> 20
        if mebibytes <= self.settings.memory and count < 2**31:
            return
        largest = int(screen.counts.argmax())
        raise MemoryError(
            f"a picture of {screen.camera.width}x{screen.camera.height} has {count} pairs of Gaussian and tile, "
            f"{mebibytes} MiB of the {self.settings.memory} MiB that `memory` allows. The largest Gaussian is number "
            f"{largest}, on {int(screen.counts[largest])} tiles. Raise `memory`, or remove Gaussians that large."
        )

    def _list(self, screen: _Screen, order: Tensor, count: int) -> _Lists:
        tiles, pairs, splats, gaussians = (
            self.empty(room, dtype=torch.int32)
            for room in (2 * _room(count), 2 * _room(count), _room(count), _room(count))
        )
        after = torch.cumsum(screen.counts[order.long()], 0, dtype=torch.int32)
        n_tiles = screen.columns * screen.rows_of_tiles
        starts, ends = self.like.new_zeros(2, n_tiles + 1, dtype=torch.int32)
        self.launch(
            list_pairs, self.n, _array(order), _array(screen.counts), _array(after), _array(screen.ellipses, types.Row),
            screen.struct, screen.wanted is not None, _array(screen.wanted), _array(screen.firsts), _array(tiles),
            _array(pairs), _array(splats),
        )  # fmt: skip
        sorted_tiles, places = _sorted(tiles, pairs, count, n_tiles.bit_length())
        self.launch(
            find_tiles, count, _array(sorted_tiles), _array(places), _array(splats), count, _array(gaussians),
            _array(starts), _array(ends),
        )  # fmt: skip
        return _Lists(count, gaussians, places, starts, ends)


class WarpRendering:
    """A picture on one screen of a frame."""

    def __init__(self, frame: _Frame, screen: _Screen) -> None:
        self._frame, self._screen = frame, screen
        height, width, lists = screen.camera.height, screen.camera.width, screen.lists
        self.image: Float[Tensor, "H W 3"] = frame.empty(height, width, 3)
        self.alpha: Float[Tensor, "H W"] = frame.empty(height, width)
        self.means2d: Float[Tensor, "N 2"] = screen.means2d
        self.visible: Bool[Tensor, " N"] = screen.visible
        self._transmittance = frame.empty(height, width)
        self._ended = frame.empty(height, width, dtype=torch.int32)
        self._reached = torch.zeros_like(lists.starts)
        frame.launch(
            blend, screen.columns * screen.rows_of_tiles * _PIXELS, screen.struct, frame.cuts,
            _array(screen.ellipses, types.Row), _array(lists.gaussians), _array(lists.starts), _array(lists.ends),
            _array(self.image, wp.vec3), _array(self.alpha), _array(self._transmittance), _array(self._ended),
            _array(self._reached),
        )  # fmt: skip

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> SplatGradients:
        """One traversal for up to three cotangents; see `Rendering.vjp`."""
        require_cotangents(cotangents, self.image)
        k, n, frame = len(cotangents), len(self.visible), self._frame
        v = cotangents.detach().to(self.image).contiguous()
        means, quats, scales, screen, rgb = (frame.empty(k, n, width) for width in (3, 4, 3, 2, 3))
        opacities = frame.empty(k, n)
        room = _room(self._screen.lists.count)
        together = max(1, min(3, ((frame.settings.memory << 20) - room * _PAIR_BYTES) // (room * _SENT_BYTES)))
        with on_stream(frame.like.device):
            for part in range(0, k, together):
                some = slice(part, part + together)
                out = (x[some] for x in (means, quats, scales, opacities, screen, rgb))
                self._pull(v[some], *out)
            return SplatGradients(means, quats, scales, opacities, screen, rgb, frame.basis())

    def _pull(self, v: Tensor, *out: Tensor) -> None:
        """Fill one to three cotangents' part of the gradients."""
        frame, screen, lists, k = self._frame, self._screen, self._screen.lists, len(v)
        sent = frame.empty(_room(lists.count), 9 * k)
        sent_row = wp.types.vector(length=9 * k, dtype=wp.float32)
        lanes = _LANES[frame.settings.device]
        wp.launch_tiled(
            blend_vjp(k, lanes), dim=[len(lists.starts)], block_dim=lanes,  # also for what is left over, see list_pairs
            device=wp.device_from_torch(frame.like.device),
            inputs=[
                screen.struct, frame.cuts, _array(screen.ellipses, types.Row), _array(lists.gaussians),
                _array(lists.places), _array(lists.starts), _array(lists.ends), _array(self._transmittance),
                _array(self._ended), _array(self._reached), _array(v, wp.vec3), wp.from_torch(sent, sent_row),
            ],
        )  # fmt: skip
        widths = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec2, wp.vec3)
        frame.launch(
            pull(k), frame.n, frame.pose, screen.struct, frame.cuts,
            _array(frame.means, wp.vec3), _array(frame.quats, wp.vec4), _array(frame.scales, wp.vec3),
            _array(screen.opacities), _array(frame.slopes, wp.mat33), frame.bands > 0,
            _array(screen.ellipses, types.Row), _array(screen.counts), _array(screen.firsts), _array(sent, sent_row),
            *(_array(x, width) for x, width in zip(out, widths, strict=True)),
        )  # fmt: skip


def _sorted(keys: Tensor, values: Tensor, count: int, bits: int) -> tuple[Tensor, Tensor]:
    """The first `count` keys and values, by key, equal ones as they came; both tensors have room for as many again."""
    if count:
        wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, end_bit=bits)
    return keys[:count], values[:count]


def _room(count: int) -> int:
    """Lengths double, so that torch finds memory of the right size among what the last picture gave back."""
    return 1 << max(0, count - 1).bit_length()


def _read_later(numbers: Tensor) -> Any:
    """Start copying device numbers to the host; the function returned waits for them, and for nothing after them."""
    if numbers.device.type == "cpu":
        return numbers.tolist
    host = torch.empty(numbers.shape, dtype=numbers.dtype, pin_memory=True)
    host.copy_(numbers, non_blocking=True)
    copied = torch.cuda.current_stream(numbers.device).record_event()

    def wait() -> list[int]:
        copied.synchronize()
        found: list[int] = host.tolist()
        return found

    return wait


def _tiles_of(mask: Tensor, camera: Camera, edge: int) -> Tensor:
    """The demand mask for our tiles, contiguous."""
    columns, rows = -(-camera.width // _TILE), -(-camera.height // _TILE)
    finer = mask.bool().repeat_interleave(edge // _TILE, 0).repeat_interleave(edge // _TILE, 1)
    return finer[:rows, :columns].contiguous()


def _pose_struct(camera: Camera) -> Any:
    pose, world = types.Pose(), camera.world_to_camera.double()
    rotation = world[:3, :3].flatten().tolist()
    pose.rotation, pose.exact_rotation = wp.mat33(*rotation), wp.mat33d(*rotation)
    pose.exact_translation = wp.vec3d(*world[:3, 3].tolist())
    pose.center = wp.vec3(*camera.center.double().tolist())
    return pose


def _screen_struct(camera: Camera, columns: int, rows: int) -> Any:
    screen = types.Screen()
    screen.exact_focal, screen.exact_principal = wp.vec2d(camera.fx, camera.fy), wp.vec2d(camera.cx, camera.cy)
    screen.focal = wp.vec2(camera.fx, camera.fy)
    screen.size, screen.tiles = wp.vec2i(camera.width, camera.height), wp.vec2i(columns, rows)
    margin_x, margin_y = _MARGIN * camera.width / (2 * camera.fx), _MARGIN * camera.height / (2 * camera.fy)
    screen.low = wp.vec2(-camera.cx / camera.fx - margin_x, -camera.cy / camera.fy - margin_y)
    right, bottom = (camera.width - camera.cx) / camera.fx, (camera.height - camera.cy) / camera.fy
    screen.high = wp.vec2(right + margin_x, bottom + margin_y)
    return screen


def _cuts_struct(settings: WarpRasterizer) -> Any:
    cuts = types.Cuts()
    cuts.kernel, cuts.near, cuts.antialiased = settings.kernel, settings.near, settings.antialiased
    cuts.near_bits = int.from_bytes(struct.pack("<d", settings.near), "little")
    cuts.alpha_min, cuts.alpha_max = settings.alpha_min, settings.alpha_max
    cuts.transmittance_min, cuts.background = settings.transmittance_min, wp.vec3(*settings.background)
    return cuts
