"""A frame: one set of Gaussians seen from one pose on one or more pixel grids. Launches the kernels, and keeps shared data.

    forward:   project (each grid) -> order by depth -> (each grid: list pairs -> blend pieces -> blend)
    backward:  blend_vjp -> fold -> project_vjp

Torch allocates all memory except the sort's scratch, and all work runs on torch's current stream. The number of pairs of
Gaussian and tile is counted on the device. The first image of a size waits for this count. Later images are launched at
once, with lists for somewhat more pairs than earlier images needed; the count is read when the image is first accessed,
and if the lists were too short, the image is drawn again before it is returned.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rasterizers.backend import packed_rows, require_cotangents, require_finite_splats, require_splats
from rasterizers.geometry import tangent_limits
from rasterizers.interface import Camera, SplatGradients, Splats
from rasterizers.recording import running
from rasterizers.warp_backend import types
from rasterizers.warp_backend.bins import find_tiles, list_pairs
from rasterizers.warp_backend.blend import blend, blend_pieces, blend_vjp
from rasterizers.warp_backend.colour import basis
from rasterizers.warp_backend.project import fold, project, project_vjp, radii
from rasterizers.warp_backend.sizes import PAIR_BYTES, SEGMENT, SUMS_BYTES, TILE, mebibytes, padded
from rasterizers.warp_runtime import lanes_on, launch, on_device, on_stream, sort_pairs

if TYPE_CHECKING:
    from rasterizers.warp_backend import WarpRasterizer

_ELLIPSE: Final = ctypes.sizeof(cast(Any, types.Ellipse).ctype) // 4
"""Numbers of a `types.Ellipse`."""
LANES: Final = 32
"""Threads per segment of the blending VJP, see `lanes_on`: a warp on CUDA."""


class _View:
    """One pixel grid of a frame: its inputs, and its results on the device."""

    def __init__(
        self, splats: Splats, camera: Camera, has_depth: bool, counts: Tensor, firsts: Tensor, visible: Tensor, total: Tensor
    ) -> None:  # fmt: skip
        n, like = len(splats), splats.means
        self.camera, self.has_depth = camera, has_depth
        self.n_tiles = math.prod(_tiles_of(camera))
        self.opacities = splats.opacities.contiguous()
        self.offsets = None if splats.rgb_offset is None else splats.rgb_offset.contiguous()
        self.grid = numbers_of(camera, like.device).grid
        self.ellipses, self.means2d = like.new_empty(n, _ELLIPSE), like.new_empty(n, 2)
        self.visible = visible
        self.counts, self.firsts = counts, firsts  # tiles of each Gaussian, and its first pair
        self.ends: Tensor  # pairs up to each Gaussian, front to back, and included; set by `WarpFrame.draw`
        self.total = total  # number of pairs
        self.pairs = 0  # set by `WarpFrame.resolve_counts`; of a recorded frame as many as it has space for
        self.lists: _Lists  # set by `WarpFrame._list`
        self.capacity = -1  # pairs that the lists have space for; the nearest ones if there are more


class _Lists(NamedTuple):
    """Pairs of Gaussian and tile. `splats` has the order of places, Gaussian by Gaussian; `tiles`, `gaussians` and `places` are
    sorted by tile, whose part is from `starts` to `ends`.
    """

    splats: Tensor
    tiles: Tensor
    gaussians: Tensor
    places: Tensor
    starts: Tensor
    ends: Tensor


class WarpFrame:
    """One depth order for several pixel grids, and the tensors that the VJP reads again."""

    def __init__(self, settings: WarpRasterizer, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> None:
        splats, camera = jobs[0]
        for job, _ in jobs:
            require_splats(job, settings.traits)
        self.settings, self.jobs, self.n, self.like = settings, jobs, len(splats), splats.means
        self.pose, self.cuts = numbers_of(camera, self.like.device).pose, _cuts_struct(settings)
        self.background = settings.background_on(self.like.device)
        self.means, self.quats, self.scales = (x.contiguous() for x in (splats.means, splats.quats, splats.scales))
        self.sh0, self.shN = packed_rows(splats.sh0), packed_rows(splats.shN)
        self.bands = self.shN.shape[1]
        self.colours = self.empty(self.n, 3)
        self.slopes = self.empty(self.n if self.bands else 0, 3, 3)
        self.depths = self.empty(self.n if any(depth) else 0)
        k = len(jobs)
        self._counts, firsts = self.empty(2, k, self.n, dtype=torch.int32).unbind()
        self._visible = self.empty(k, self.n, dtype=torch.bool)
        # The number of pairs on each grid, and the flags of `project.project`.
        self.totals = self.like.new_zeros(k + 3, dtype=torch.int64)
        each = zip(jobs, depth, self._counts, firsts, self._visible, self.totals[:k, None], strict=True)
        self.views = [_View(*job, *others) for job, *others in each]
        self._read: Callable[[], list[int]]  # the numbers of `totals`; set by `draw`
        self.resolved = False

    def draw(self) -> list[WarpRendering]:
        """An image on each grid. Errors in the input may be raised only when an image is first accessed."""
        with on_stream(self.like.device):
            keys, places = self.project()
            self._order = sort_pairs(keys, places, self.n, 31)[1]
            ends = torch.cumsum(self._counts.index_select(1, self._order), 1)  # in 64 bits
            for view, ends_of_view in zip(self.views, ends, strict=True):
                view.ends = ends_of_view
            if self.n:
                self.totals[: len(ends)] = ends[:, -1]
            if (recording := running()) is not None:
                numbers = recording.pause(self.totals.tolist, self._fits)
                self._read = lambda: numbers
                self.resolve_counts(recorded=True)
                return [WarpRendering(self, view) for view in self.views]
            self._read = _read_deferred(self.totals)
            capacities = [self.settings.capacity(view.camera) for view in self.views]
            if min(capacities) >= 0:
                for nth, capacity in enumerate(capacities):
                    self._list(nth, capacity)
            else:
                self.resolve_counts()
            return [WarpRendering(self, view) for view in self.views]

    def resolve_counts(self, *, recorded: bool = False) -> None:
        """Read the numbers of pairs, and list the pairs again where the lists were too short.

        Args:
            recorded: replays may have other numbers of pairs, as far as there is space for them.

        Raises:
            ValueError: a number is not finite.
            MemoryError: the lists of an image would exceed the budget.
        """
        if self.resolved:
            return
        *pairs, not_finite, is_long, is_longer = self._read()
        self.folds = (1,) * (recorded or is_long) + (SEGMENT,) * (recorded or is_longer)
        if not_finite:
            for splats, _ in self.jobs:
                require_finite_splats(splats)
        for nth, (view, count) in enumerate(zip(self.views, pairs, strict=True)):
            self._require_memory(view, count)
            self.settings.remember(view.camera, count)
            view.pairs = self.settings.capacity(view.camera) if recorded else count
            if view.capacity < view.pairs:
                self._list(nth, view.pairs)
        self.resolved = True

    def _fits(self) -> bool:
        """Return True if the lists of a recorded frame have space for its replay's pairs, and its numbers are finite."""
        *pairs, not_finite, _, _ = self.totals.tolist()
        for view, count in zip(self.views, pairs, strict=True):
            if not self.settings.allows(count):
                return False
            self.settings.remember(view.camera, count)
        return not not_finite and all(count <= view.pairs for view, count in zip(self.views, pairs, strict=True))

    def empty(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        return self.like.new_empty(shape, dtype=dtype)

    @cached_property
    def basis(self) -> Float[Tensor, "N B1"]:
        """Y of this pose's directions, computed once for all grids."""
        Y = self.empty(self.n, self.bands + 1)
        launch(basis, [self.n], (self.pose, self.means, self._visible, Y))
        return Y

    def project(self) -> tuple[Tensor, Tensor]:
        """Project onto each grid. Returns depth keys and their Gaussians, with space for sorting."""
        keys, places = (self.empty(2 * self.n, dtype=torch.int32) for _ in range(2))
        for nth, view in enumerate(self.views):
            arguments = (
                self.pose, view.grid, self.cuts, self.means, self.quats, self.scales, view.opacities, self.sh0, self.shN,
                view.offsets, nth == 0, keys, places, self.colours, self.slopes, self.depths, view.ellipses, view.means2d,
                view.visible, view.counts, self.totals[len(self.views) :],
            )  # fmt: skip
            launch(project, [self.n], arguments)
        return keys, places

    def _require_memory(self, view: _View, count: int) -> None:
        """Refuse counts beyond the budget. Counts are 64-bit up to here, and fit 32 bits after it."""
        if self.settings.allows(count):
            return
        largest = int(view.counts.argmax())
        raise MemoryError(
            f"an image of {view.camera.width}x{view.camera.height} has {count} pairs of Gaussian and tile, "
            f"{mebibytes(count)} MiB of the {self.settings.memory} MiB that `memory` allows. The largest Gaussian is number "
            f"{largest}, on {int(view.counts[largest])} tiles. Raise `memory`, or remove Gaussians that large."
        )

    def _list(self, nth: int, capacity: int) -> None:
        """List the pairs of a grid. Places without a pair are sorted to the end."""
        view, length = self.views[nth], padded(capacity)
        tiles, places, splats, gaussians = (
            self.empty(n, dtype=torch.int32) for n in (2 * length, 2 * length, length, length)
        )
        starts, ends = self.like.new_zeros(2, view.n_tiles + 1, dtype=torch.int32)
        listed = self._order, view.ends, view.ellipses, view.grid, view.firsts, tiles, places, splats
        launch(list_pairs, [capacity], listed)
        tiles, places = sort_pairs(tiles, places, capacity, view.n_tiles.bit_length())
        launch(find_tiles, [capacity], (tiles, places, splats, view.total, capacity, gaussians, starts, ends))
        view.capacity, view.lists = capacity, _Lists(splats, tiles, gaussians, places, starts, ends)


class WarpRendering:
    """An image on one pixel grid of a frame. Accessing it resolves the frame's counts."""

    def __init__(self, frame: WarpFrame, view: _View) -> None:
        self._frame, self._view = frame, view
        height, width = view.camera.height, view.camera.width
        self.means2d: Float[Tensor, "N 2"] = view.means2d
        self.visible: Bool[Tensor, " N"] = view.visible
        self._image, self._transmittance = frame.empty(height, width, 3), frame.empty(height, width)
        self._ended = frame.empty(height, width, dtype=torch.int32)
        self._depth = frame.empty(height, width) if view.has_depth else None
        self._blend()

    @property
    def image(self) -> Float[Tensor, "H W 3"]:
        self._resolve()
        return self._image

    @property
    def alpha(self) -> Float[Tensor, "H W"]:
        self._resolve()
        return 1 - self._transmittance

    @property
    def depth(self) -> Float[Tensor, "H W"] | None:
        self._resolve()
        return self._depth

    @property
    def radii(self) -> Int[Tensor, "N 2"]:
        """See `WithTraits`."""
        frame, view = self._frame, self._view
        out = frame.empty(frame.n, 2, dtype=torch.int32)
        of_view = frame.means, frame.quats, frame.scales, view.opacities, view.visible
        launch(radii, [frame.n], (frame.pose, view.grid, frame.cuts, *of_view, out))
        return out

    def _resolve(self) -> None:
        frame = self._frame
        if frame.resolved and self._drawn_from is self._view.lists:
            return
        with on_stream(frame.like.device):
            frame.resolve_counts()
            if self._drawn_from is not self._view.lists:
                self._blend()

    def _blend(self) -> None:
        frame, view, lists = self._frame, self._view, self._view.lists
        self._drawn_from = lists
        n_tiles, segments = view.n_tiles, -(-view.capacity // SEGMENT)
        pieces = self._marks = frame.empty(segments + n_tiles, types.PIXELS, 4)
        sums = frame.empty(segments + n_tiles, types.PIXELS, 2) if view.has_depth else None
        alone = (
            view.grid, frame.cuts, view.ellipses, frame.depths, lists.tiles, lists.gaussians, view.total, view.capacity, pieces,
            sums,
        )  # fmt: skip
        kernel = blend_pieces(view.has_depth, lanes_on(frame.like.device, types.PIXELS))  # on CUDA a thread per pixel
        launch(kernel, [segments], alone, block=types.PIXELS, together=True)
        drawn = (
            view.grid, frame.cuts, frame.background, view.ellipses, frame.depths, lists.gaussians, lists.starts, lists.ends,
            pieces, sums, self._image, self._transmittance, self._ended, self._depth,
        )  # fmt: skip
        launch(blend(view.has_depth), [n_tiles, types.PIXELS], drawn, block=types.PIXELS)

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], *, absgrad: bool = False) -> SplatGradients:
        """One pass for up to three cotangents, with absolute gradients for one; see `Rendering.vjp`."""
        require_cotangents(cotangents, self.image)
        frame, k = self._frame, len(cotangents)
        v = cotangents.to(self._image).contiguous()
        out, together = _empty_gradients(frame, k, k), 1 if absgrad else self._together()
        absolute = frame.empty(k, frame.n, 2) if absgrad else None
        with on_stream(frame.like.device):
            if k <= together:
                self._fill(v, *out, absolute)
            else:
                for first in range(0, k, together):
                    at = slice(first, first + together)
                    self._fill(v[at], *(x[at] for x in out), None if absolute is None else absolute[at])
            return SplatGradients(*out, frame.basis, absolute)

    def summed_vjp(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"]) -> SplatGradients:
        """One pass for two or three cotangents; see `WithTraits`."""
        require_cotangents(cotangents, self.image)
        k = len(cotangents)
        if not 1 < k <= self._together():
            return self.vjp(cotangents).summed(weight)
        out = _empty_gradients(self._frame, k - 1, k)
        with on_stream(self._frame.like.device):
            self._fill(cotangents.to(self._image).contiguous(), *out, None, weight=weight.to(self._image).contiguous())
            return SplatGradients(*out, self._frame.basis)

    def _together(self) -> int:
        """How many cotangents one pass has the memory for."""
        capacity, memory = padded(self._view.pairs), self._frame.settings.memory << 20
        return max(1, min(3, (memory - capacity * PAIR_BYTES) // (capacity * SUMS_BYTES)))

    def _fill(self, v: Tensor, *out: Tensor | None, weight: Tensor | None = None) -> None:
        """Fill the gradients for one to three cotangents, the last of them where absolute ones are wanted."""
        absolute = out[-1] is not None
        frame, view, lists, k = self._frame, self._view, self._drawn_from, v.shape[0]
        pair_sums = frame.empty(padded(view.pairs), types.width_of(k, absolute))
        kernel = blend_vjp(k, lanes_on(v.device, LANES), v.device.type == "cuda", absolute)
        blended = (
            view.grid, frame.cuts, frame.background, view.ellipses, lists.tiles, lists.gaussians, lists.places, lists.ends,
            self._transmittance, self._ended, self._marks, v, view.total, pair_sums,
        )  # fmt: skip
        launch(kernel, [-(-view.pairs // SEGMENT)], blended, block=LANES, together=True)
        for stride in (1, SEGMENT):  # without pairs a recording, which folds by both, finds the kernel loaded
            pairs = view.pairs if stride in frame.folds else 0
            launch(fold(k, absolute), [pairs], (view.counts, view.firsts, lists.splats, view.total, stride, pair_sums))
        projected = (
            frame.pose, view.grid, frame.cuts, frame.means, frame.quats, frame.scales, view.opacities, frame.slopes,
            view.ellipses, view.counts, view.firsts, pair_sums, *out, weight,
        )  # fmt: skip
        launch(project_vjp(k, absolute, weight is not None), [frame.n], projected)


def _empty_gradients(frame: WarpFrame, j: int, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Means, quats, scales, opacities, screen and rgb."""
    n, empty = frame.n, frame.empty
    return empty(j, n, 3), empty(j, n, 4), empty(j, n, 3), empty(j, n), empty(k, n, 2), empty(k, n, 3)


def _read_deferred(numbers: Tensor) -> Any:
    """Start copying device numbers to the host; the returned function waits for this copy only."""
    if numbers.device.type == "cpu":
        return numbers.tolist
    host = torch.empty(numbers.shape, dtype=numbers.dtype, device="cpu", pin_memory=True)
    host.copy_(numbers, non_blocking=True)
    copied = torch.cuda.current_stream(numbers.device).record_event()

    def wait() -> list[int]:
        copied.synchronize()
        read: list[int] = host.tolist()
        return read

    return wait


def _tiles_of(camera: Camera) -> tuple[int, int]:
    """Columns and rows of tiles."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


class CameraNumbers(NamedTuple):
    """A camera's numbers on the device: `types.Pose` and `types.Grid`, as bytes."""

    pose: Tensor
    grid: Tensor


@lru_cache(maxsize=1024)
def numbers_of(camera: Camera, device: torch.device) -> CameraNumbers:
    """Those of this camera object. The device of tensors has a number, which "cuda" lacks."""
    if str(device) == "cuda":
        return numbers_of(camera, torch.device("cuda", torch.cuda.current_device()))
    pose, world = types.Pose(), camera.world_to_camera.double()
    rotation = world[:3, :3].flatten().tolist()
    pose.rotation, pose.exact_rotation = wp.mat33(*rotation), wp.mat33d(*rotation)
    pose.exact_translation = wp.vec3d(*world[:3, 3].tolist())
    pose.center = wp.vec3(*camera.center.double().tolist())
    grid = types.Grid()
    grid.exact_focal, grid.exact_principal = wp.vec2d(camera.fx, camera.fy), wp.vec2d(camera.cx, camera.cy)
    grid.focal = wp.vec2(camera.fx, camera.fy)
    grid.size = wp.vec2i(camera.width, camera.height)
    grid.tiles = wp.vec2i(*_tiles_of(camera))
    (left, right), (top, bottom) = tangent_limits(camera)
    grid.low, grid.high = wp.vec2(left, top), wp.vec2(right, bottom)
    structures: tuple[Any, Any] = pose, grid
    return CameraNumbers(*(on_device(x.__ctype__(), device) for x in structures))


@lru_cache(maxsize=1024)
def _cuts_struct(settings: WarpRasterizer) -> Any:
    cuts = types.Cuts()
    cuts.kernel, cuts.near, cuts.antialiased = settings.kernel, settings.near, settings.antialiased
    cuts.near_bits = int.from_bytes(struct.pack("<d", settings.near), "little")
    cuts.alpha_min, cuts.alpha_max = settings.alpha_min, settings.alpha_max
    cuts.transmittance_min = max(settings.transmittance_min, 1e-30)  # as in C++: no VJP rebuilds a subnormal T
    return cuts.__ctype__()  # type: ignore[attr-defined]
