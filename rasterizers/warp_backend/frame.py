"""A frame: one set of Gaussians seen from one pose on one or more screens. Runs the kernels and keeps what they share.

    project (each screen) -> order by depth -> (each screen: list pairs -> blend)          and back: blend_vjp -> pull

Memory is torch's (but the sort's scratch), and all work goes to torch's current stream. Only the device knows how many
pairs of Gaussian and tile a picture has. The first picture of its size waits for that number. Those after it are launched
whole, with room for as many pairs as were needed before and some more; the number is read when somebody first looks at
the picture, and should the room not have sufficed, it is drawn again before it is seen.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from rasterizers.checks import packed_rows, require_cotangents, require_finite, require_tiles, shares, spread
from rasterizers.interface import Camera, RasterSettings, Rendering, SplatGradients, Splats, Traits
from rasterizers.warp_backend import types
from rasterizers.warp_backend.bins import find_tiles, list_pairs
from rasterizers.warp_backend.blend import blend, blend_vjp
from rasterizers.warp_backend.colour import basis
from rasterizers.warp_backend.launch import array, on_stream
from rasterizers.warp_backend.project import project, pull

_TILE: Final = int(types.TILE)
_PIXELS: Final = int(types.PIXELS)
_ROW: Final = 14
_MARGIN: Final = 0.3  # share of the half field of view beyond the image up to which the Jacobian follows
_PAIR_BYTES: Final = 24  # tile and place, twice for the sort, and the Gaussian, before and after it
_SENT_BYTES: Final = 36  # what a pair sends back for one cotangent
_LATE: Final = {"cuda": True, "cpu": False}  # whether numbers that are counted on the device are read late
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
    _rooms: dict[tuple[int, int], int] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        RasterSettings.__post_init__(self)
        if self.tile % _TILE:
            raise ValueError(f"tile must be a multiple of {_TILE} pixels, got {self.tile}.")
        if self.memory < 1:
            raise ValueError(f"memory must be at least 1 MiB, got {self.memory}.")

    def room(self, screen: Camera) -> int:
        """For how many pairs a picture of this size gets room before they are counted; -1: none was drawn yet."""
        return self._rooms.get((screen.width, screen.height), -1)

    def remember(self, screen: Camera, pairs: int) -> None:
        """Room for a quarter more than a picture needed; what others needed is forgotten slowly."""
        room = max(pairs + pairs // 4, self.room(screen) * 63 // 64)
        self._rooms[screen.width, screen.height] = room if self.allows(room) else pairs

    def allows(self, pairs: int) -> bool:
        """Whether lists of so many pairs, which are counted in 32 bits, stay within the budget."""
        return _mebibytes(pairs) <= self.memory and pairs < 2**31

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
            return [*_Frame(self, jobs, masks).draw()]
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
        self.pairs = 0  # as the host knows it, see `_Frame.settle`
        self.lists: _Lists  # once they are sorted …
        self.room = -1  # … of so many pairs; should there be more, of the foremost


@dataclass(frozen=True, slots=True, eq=False)
class _Lists:
    """Pairs of Gaussian and tile: the Gaussians tile by tile, and each pair's place among those of its Gaussian."""

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
        self._settled = False

    def draw(self) -> list[WarpRendering]:
        """A picture on each screen. What is wrong with its input may be said when it is first looked at."""
        with on_stream(self.like.device):
            keys = self._project()
            self._read = _read_later(self._totals)
            places = torch.arange(2 * self.n, dtype=torch.int32, device=self.like.device)
            self._order = _sorted(keys, places, self.n, 31)[1]
            rooms = [self.settings.room(screen.camera) for screen in self.screens]
            if _LATE[self.settings.device] and min(rooms) >= 0:
                for nth, room in enumerate(rooms):
                    self._list(nth, room)
            else:
                self.settle()
            return [WarpRendering(self, screen) for screen in self.screens]

    def settle(self) -> None:
        """Read how many pairs there are, and list them anew where they were given too little room.

        Raises:
            ValueError: a number is not finite.
            MemoryError: the lists of a picture would pass the budget.
        """
        if self._settled:
            return
        *pairs, poison = self._read()
        if poison:
            for splats, _ in self.jobs:
                require_finite(splats)
        for nth, (screen, count) in enumerate(zip(self.screens, pairs, strict=True)):
            self._require_memory(screen, count)
            self.settings.remember(screen.camera, count)
            screen.pairs = count
            if screen.room < count:
                self._list(nth, count)
        self._settled = True

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
            arguments = (self.pose, array(self.means, wp.vec3), array(visible), array(self._basis))
            self.launch(basis, self.n, *arguments)
        return self._basis

    def _project(self) -> Tensor:
        """Depth keys, with room for sorting them; and the totals: pairs of each screen, and poison."""
        keys = self.empty(2 * self.n, dtype=torch.int32)
        poison = self.like.new_zeros(1, dtype=torch.int64)
        for nth, screen in enumerate(self.screens):
            self.launch(
                project, self.n, self.pose, screen.struct, self.cuts,
                array(self.means, wp.vec3), array(self.quats, wp.vec4), array(self.scales, wp.vec3),
                array(screen.opacities), array(self.sh0, wp.vec3), array(self.shN, wp.vec3),
                screen.offsets is not None, array(screen.offsets, wp.vec3),
                screen.wanted is not None, array(screen.wanted), nth == 0,
                array(keys), array(self.colours, wp.vec3), array(self.slopes, wp.mat33),
                array(screen.ellipses, types.Row), array(screen.means2d, wp.vec2), array(screen.visible),
                array(screen.counts), array(poison),
            )  # fmt: skip
        self._totals = torch.cat([*(screen.counts.sum(0, True) for screen in self.screens), poison])
        return keys

    def _require_memory(self, screen: _Screen, count: int) -> None:
        """Counts are 64-bit until here, where they are found to fit."""
        if self.settings.allows(count):
            return
        largest = int(screen.counts.argmax())
        raise MemoryError(
            f"a picture of {screen.camera.width}x{screen.camera.height} has {count} pairs of Gaussian and tile, "
            f"{_mebibytes(count)} MiB of the {self.settings.memory} MiB that `memory` allows. The largest Gaussian is number "
            f"{largest}, on {int(screen.counts[largest])} tiles. Raise `memory`, or remove Gaussians that large."
        )

    def _list(self, nth: int, room: int) -> None:
        """The lists of a screen; places that no pair takes are sorted behind all others."""
        screen, of = self.screens[nth], _room(room)
        tiles, pairs, splats, gaussians = (self.empty(length, dtype=torch.int32) for length in (2 * of, 2 * of, of, of))
        after = torch.cumsum(screen.counts[self._order.long()], 0)
        n_tiles = screen.columns * screen.rows_of_tiles
        tiles[:room].fill_(n_tiles)
        starts, ends = self.like.new_zeros(2, n_tiles + 1, dtype=torch.int32)
        self.launch(
            list_pairs, self.n, array(self._order), array(screen.counts), array(after),
            array(screen.ellipses, types.Row), screen.struct, screen.wanted is not None, array(screen.wanted), room,
            array(screen.firsts), array(tiles), array(pairs), array(splats),
        )  # fmt: skip
        sorted_tiles, places = _sorted(tiles, pairs, room, n_tiles.bit_length())
        self.launch(
            find_tiles, room, array(sorted_tiles), array(places), array(splats), array(self._totals), nth, room,
            array(gaussians), array(starts), array(ends),
        )  # fmt: skip
        screen.room, screen.lists = room, _Lists(gaussians, places, starts, ends)


class WarpRendering:
    """A picture on one screen of a frame; to look at it is to settle the frame."""

    def __init__(self, frame: _Frame, screen: _Screen) -> None:
        self._frame, self._screen = frame, screen
        height, width = screen.camera.height, screen.camera.width
        self.means2d: Float[Tensor, "N 2"] = screen.means2d
        self.visible: Bool[Tensor, " N"] = screen.visible
        self._image, self._alpha = frame.empty(height, width, 3), frame.empty(height, width)
        self._transmittance = frame.empty(height, width)
        self._ended = frame.empty(height, width, dtype=torch.int32)
        self._blend()

    @property
    def image(self) -> Float[Tensor, "H W 3"]:
        self._settle()
        return self._image

    @property
    def alpha(self) -> Float[Tensor, "H W"]:
        self._settle()
        return self._alpha

    def _settle(self) -> None:
        with on_stream(self._frame.like.device):
            self._frame.settle()
            if self._drawn_from is not self._screen.lists:
                self._blend()

    def _blend(self) -> None:
        frame, screen, lists = self._frame, self._screen, self._screen.lists
        self._drawn_from, self._reached = lists, torch.zeros_like(lists.starts)
        frame.launch(
            blend, screen.columns * screen.rows_of_tiles * _PIXELS, screen.struct, frame.cuts,
            array(screen.ellipses, types.Row), array(lists.gaussians), array(lists.starts), array(lists.ends),
            array(self._image, wp.vec3), array(self._alpha), array(self._transmittance), array(self._ended),
            array(self._reached),
        )  # fmt: skip

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> SplatGradients:
        """One traversal for up to three cotangents; see `Rendering.vjp`."""
        require_cotangents(cotangents, self.image)
        k, n, frame = len(cotangents), len(self.visible), self._frame
        v = cotangents.detach().to(self._image).contiguous()
        means, quats, scales, screen, rgb = (frame.empty(k, n, width) for width in (3, 4, 3, 2, 3))
        opacities = frame.empty(k, n)
        room = _room(self._screen.pairs)
        together = max(1, min(3, ((frame.settings.memory << 20) - room * _PAIR_BYTES) // (room * _SENT_BYTES)))
        with on_stream(frame.like.device):
            for part in range(0, k, together):
                some = slice(part, part + together)
                out = (x[some] for x in (means, quats, scales, opacities, screen, rgb))
                self._pull(v[some], *out)
            return SplatGradients(means, quats, scales, opacities, screen, rgb, frame.basis())

    def _pull(self, v: Tensor, *out: Tensor) -> None:
        """Fill one to three cotangents' part of the gradients."""
        frame, screen, lists, k = self._frame, self._screen, self._drawn_from, len(v)
        sent = frame.empty(_room(screen.pairs), 9 * k)
        sent_row = wp.types.vector(length=9 * k, dtype=wp.float32)
        lanes = _LANES[frame.settings.device]
        wp.launch_tiled(
            blend_vjp(k, lanes), dim=[len(lists.starts)], block_dim=lanes,  # also for what is left over, see list_pairs
            device=wp.device_from_torch(frame.like.device),
            inputs=[
                screen.struct, frame.cuts, array(screen.ellipses, types.Row), array(lists.gaussians),
                array(lists.places), array(lists.starts), array(lists.ends), array(self._transmittance),
                array(self._ended), array(self._reached), array(v, wp.vec3), wp.from_torch(sent, sent_row),
            ],
        )  # fmt: skip
        widths = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec2, wp.vec3)
        frame.launch(
            pull(k), frame.n, frame.pose, screen.struct, frame.cuts,
            array(frame.means, wp.vec3), array(frame.quats, wp.vec4), array(frame.scales, wp.vec3),
            array(screen.opacities), array(frame.slopes, wp.mat33), frame.bands > 0,
            array(screen.ellipses, types.Row), array(screen.counts), array(screen.firsts), array(sent, sent_row),
            *(array(x, width) for x, width in zip(out, widths, strict=True)),
        )  # fmt: skip


def _sorted(keys: Tensor, values: Tensor, count: int, bits: int) -> tuple[Tensor, Tensor]:
    """The first `count` keys and values, by key, equal ones as they came; both tensors have room for as many again."""
    if count:
        wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, end_bit=bits)
    return keys[:count], values[:count]


def _room(count: int) -> int:
    """Lengths double, so that torch finds memory of the right size among what the last picture gave back."""
    return 1 << max(0, count - 1).bit_length()


def _mebibytes(pairs: int) -> int:
    """Of their lists, and of what they send back for one cotangent."""
    return _room(pairs) * (_PAIR_BYTES + _SENT_BYTES) >> 20


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
    return spread(mask.bool(), edge // _TILE, rows, columns).contiguous()


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
