"""Peers on CUDA: other people's rasterizers as other people use them, to be timed and judged beside ours.

They take part in this benchmark and nowhere else, so no more of them is wrapped than it needs: a picture, and one backward
pass for each cotangent. Each draws by its own rules, which are said beside the table, and is judged by them.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from types import MappingProxyType
from typing import Any, Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

import rasterizers
from clear_strategies.bench import scenes
from clear_strategies.bench.accuracy import Picture
from clear_strategies.bench.scenes import SETTINGS, Workload

PRESET: Final = "fast"
"""The cut-offs that all of them have, alpha 1/255 and transmittance 1e-4, and cannot change."""

_FAR: Final = 100.0  # gswarp's matrix wants a far plane; nothing is cut there
_LEAVES: Final = ("means", "quats", "scales", "opacities", "sh0", "shN")

Leaves = Mapping[str, Tensor]


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A picture, and what pulls one cotangent back to the tensors of `accuracy.ATTRIBUTES`."""

    image: Float[Tensor, "H W 3"]
    vjp: Callable[[Float[Tensor, "H W 3"]], Mapping[str, Tensor]]


@dataclass(frozen=True, slots=True, eq=False)
class Peer:
    """A rasterizer that is not ours.

    Args:
        says: what it computes that we do not, and the other way round.
        differs: its rules where they are not `scenes.SETTINGS`; the truth that it is held against follows them.
    """

    name: str
    draw: Callable[[Workload], Drawing]
    says: str
    differs: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def picture(self, workload: Workload, cotangent: Float[Tensor, "H W 3"]) -> Picture:
        """The image, and the gradients for one cotangent; in main memory."""
        drawing = self.draw(workload)
        gradients = drawing.vjp(cotangent)
        return Picture(drawing.image.detach().cpu(), {name: gradients[name].cpu() for name in _LEAVES})


def found(skip: Callable[[str], None]) -> list[Peer]:
    """Those that draw on this machine's GPU, each tried on a tiny scene; one line for each that does not."""
    peers: list[Peer] = []
    for name, build in _PEERS.items():
        try:
            candidates = build(metadata.version(name))
            for peer in candidates:
                _try(peer)
            peers += candidates
        except metadata.PackageNotFoundError:
            skip(f"{name}: not installed (pip install {name}).")
        except Exception as error:  # another's library fails as it likes, often when it compiles itself at first use
            skip(f"{name}: it cannot be used ({(str(error) or type(error).__name__).splitlines()[0]}).")
    return peers


def gsplat(rasterization: Callable[..., Any], name: str) -> Peer:
    """The `rasterization` of gsplat, or a function of its shape, called as its example trainer does."""

    def draw(workload: Workload, g: Leaves) -> Tensor:
        camera, like = workload.camera, workload.splats.means
        K = like.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        images, _, _ = rasterization(
            g["means"], g["quats"], g["scales"], g["opacities"], torch.cat((g["sh0"], g["shN"]), 1),
            camera.world_to_camera.to(like)[None], K[None], camera.width, camera.height, near_plane=SETTINGS["near"],
            eps2d=SETTINGS["kernel"], sh_degree=_degree(workload), packed=False, rasterize_mode="antialiased",
        )  # fmt: skip
        image: Tensor = images[0]
        return image

    return Peer(name, _taped(draw), "antialiased, as ours; sums by atomics, so not deterministic.")


def gswarp(library: Any, name: str) -> Peer:
    """The `GaussianRasterizer` of gswarp, or a library of its shape, called as an Inria-style trainer does."""

    def draw(workload: Workload, g: Leaves) -> Tensor:
        camera, like = workload.camera, workload.splats.means
        view = camera.world_to_camera.to(like)
        settings = library.GaussianRasterizationSettings(
            image_height=camera.height, image_width=camera.width, tanfovx=camera.width / (2 * camera.fx),
            tanfovy=camera.height / (2 * camera.fy), bg=like.new_zeros(3), scale_modifier=1.0,
            viewmatrix=view.T.contiguous(), projmatrix=(_clip(workload) @ view).T.contiguous(),
            sh_degree=_degree(workload), campos=camera.center.to(like), prefiltered=False, auto_tune_verbose=False,
        )  # fmt: skip
        image: Tensor = library.GaussianRasterizer(settings)(
            means3D=g["means"], means2D=torch.zeros_like(g["means"], requires_grad=True),
            opacities=g["opacities"][:, None], dc=g["sh0"], shs=g["shN"], scales=g["scales"],
            rotations=F.normalize(g["quats"]),
        )[0]  # fmt: skip
        return image.movedim(0, -1)

    says = (
        "no antialiasing, so the compensation of each Gaussian and its gradient are work that it does not do; Gaussians "
        "end at 3 sigma, its near plane is 0.2 and alpha at most 0.99; draws a depth, too; sums by atomics, so not "
        "deterministic."
    )
    return Peer(name, _taped(draw), says, MappingProxyType({"antialiased": False, "alpha_max": 0.99, "near": 0.2}))


def _behind_our_interface(version: str) -> Peer:
    """`rasterizer=gsplat` of a run."""
    own = {name: value for name, value in SETTINGS.items() if name != "alpha_max"}  # 0.999 there, and no choice
    rasterizer = rasterizers.load("gsplat", preset=PRESET, **own)

    def draw(workload: Workload) -> Drawing:
        rendering = rasterizer(workload.splats, workload.camera)

        def vjp(cotangent: Tensor) -> Mapping[str, Tensor]:
            g = rendering.vjp(cotangent[None])
            return {name: getattr(g, name)[0] for name in _LEAVES}

        return Drawing(rendering.image, vjp)

    return Peer(
        f"gsplat {version}, rasterizer=gsplat", draw, "the same kernels in our trainer, with all that it asks for."
    )


def _installed_gsplat(version: str) -> list[Peer]:
    wrapped = _behind_our_interface(version)  # says why where it cannot run
    return [gsplat(importlib.import_module("gsplat.rendering").rasterization, f"gsplat {version}"), wrapped]


def _installed_gswarp(version: str) -> list[Peer]:
    library = importlib.import_module("gswarp")
    library.initialize_runtime_tuning(device="cuda:0", verbose=False)  # as its page recommends
    return [gswarp(library, f"gswarp {version}")]


_PEERS: Final[Mapping[str, Callable[[str], list[Peer]]]] = {"gsplat": _installed_gsplat, "gswarp": _installed_gswarp}


def _try(peer: Peer) -> None:
    tiny = scenes.load("tiny")
    if isinstance(tiny, scenes.Workload):
        tiny = tiny.to("cuda")
        peer.picture(tiny, torch.ones(tiny.camera.height, tiny.camera.width, 3, device="cuda"))


def _taped(draw: Callable[[Workload, Leaves], Tensor]) -> Callable[[Workload], Drawing]:
    """By autograd: a backward pass for each cotangent, the graph kept for the next."""

    def drawing(workload: Workload) -> Drawing:
        leaves = {name: getattr(workload.splats, name).detach().requires_grad_() for name in _LEAVES}
        with torch.enable_grad():
            image = draw(workload, leaves)

        def vjp(cotangent: Tensor) -> Mapping[str, Tensor]:
            tensors = list(leaves.values())
            gradients = torch.autograd.grad(image, tensors, cotangent, retain_graph=True, materialize_grads=True)
            return dict(zip(leaves, gradients, strict=True))

        return Drawing(image, vjp)

    return drawing


def _degree(workload: Workload) -> int:
    return math.isqrt(workload.splats.shN.shape[1] + 1) - 1


def _clip(workload: Workload) -> Float[Tensor, "4 4"]:
    """Camera to clip space as Inria's trainer has it, with the principal point where it is."""
    camera, near = workload.camera, SETTINGS["near"]
    rows = [
        [2 * camera.fx / camera.width, 0, 2 * camera.cx / camera.width - 1, 0],
        [0, 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1, 0],
        [0, 0, _FAR / (_FAR - near), -_FAR * near / (_FAR - near)],
        [0, 0, 1, 0],
    ]
    return workload.splats.means.new_tensor(rows)
