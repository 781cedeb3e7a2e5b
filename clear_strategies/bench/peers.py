"""Other projects' rasterizers on CUDA, called as their users call them, and compared with float64 by their own rules."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from types import SimpleNamespace
from typing import Any, Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from clear_strategies.bench import scenes
from clear_strategies.bench.accuracy import ATTRIBUTES
from clear_strategies.bench.scenes import SETTINGS, Workload

PRESET: Final = "fast"  # the cut-offs that all peers have built in: alpha 1/255 and transmittance 1e-4
_FAR: Final = 100.0  # the far plane of gswarp's projection matrix; nothing is cut there

Leaves = Mapping[str, Tensor]


@dataclass(frozen=True, slots=True, eq=False)
class Peer:
    """A rasterizer of another project.

    Args:
        differences: between what it computes and what our rasterizers compute.
        rules: its settings where they differ from `scenes.SETTINGS`.
    """

    name: str
    render: Callable[[Workload], SimpleNamespace]
    differences: str
    rules: Mapping[str, Any] = field(default_factory=dict)


def available(note: Callable[[str], None]) -> list[Peer]:
    """The peers that draw a tiny scene on this GPU; `note` gets why the others do not."""
    peers: list[Peer] = []
    for name in ("gsplat", "gswarp"):
        try:
            version, library = metadata.version(name), importlib.import_module(name)
            if name == "gsplat":
                peer = gsplat(library.rasterization, f"gsplat {version}")
            else:
                library.initialize_runtime_tuning(device="cuda:0", verbose=False)  # as its documentation recommends
                peer = gswarp(library, f"gswarp {version}")
            tiny = scenes.load("tiny").to("cuda")
            peer.render(tiny).vjp(torch.ones(1, tiny.camera.height, tiny.camera.width, 3, device="cuda"))
            peers.append(peer)
        except metadata.PackageNotFoundError:
            note(f"{name}: not installed (pip install {name}).")
        except Exception as error:  # a library may raise anything when it compiles itself
            note(f"{name}: cannot be used ({(str(error) or type(error).__name__).splitlines()[0]}).")
    return peers


def gsplat(rasterization: Callable[..., Any], name: str) -> Peer:
    """The `rasterization` of gsplat, called as its example trainer does."""

    def draw(workload: Workload, g: Leaves) -> Tensor:
        camera, like = workload.camera, workload.splats.means
        K = like.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        image: Tensor = rasterization(
            g["means"], g["quats"], g["scales"], g["opacities"], torch.cat((g["sh0"], g["shN"]), 1),
            camera.world_to_camera.to(like)[None], K[None], camera.width, camera.height, near_plane=SETTINGS["near"],
            eps2d=SETTINGS["kernel"], sh_degree=_degree(workload), packed=False, rasterize_mode="antialiased",
        )[0][0]  # fmt: skip
        return image

    return Peer(name, _by_autograd(draw), "antialiased, as ours; not deterministic (atomic sums).")


def gswarp(library: Any, name: str) -> Peer:
    """The `GaussianRasterizer` of gswarp, called as an Inria-style trainer does."""

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

    differences = (
        "no antialiasing, so it does less work per Gaussian; Gaussians end at 3 sigma, near plane 0.2, alpha at most "
        "0.99; also draws a depth map; not deterministic (atomic sums)."
    )
    return Peer(name, _by_autograd(draw), differences, {"antialiased": False, "alpha_max": 0.99, "near": 0.2})


def _by_autograd(draw: Callable[[Workload, Leaves], Tensor]) -> Callable[[Workload], SimpleNamespace]:
    """Draws a workload: `image`, and `vjp` of K cotangents, one backward pass each, whose attributes are lists of K gradients."""

    def render(workload: Workload) -> SimpleNamespace:
        leaves = {name: getattr(workload.splats, name).detach().requires_grad_() for name in ATTRIBUTES}
        with torch.enable_grad():
            image = draw(workload, leaves)

        def vjp(cotangents: Float[Tensor, "K H W 3"]) -> SimpleNamespace:
            keep = {"retain_graph": True, "materialize_grads": True}
            gradients = [torch.autograd.grad(image, list(leaves.values()), v, **keep) for v in cotangents]
            return SimpleNamespace(**dict(zip(leaves, zip(*gradients, strict=True), strict=True)))

        return SimpleNamespace(image=image, vjp=vjp)

    return render


def _degree(workload: Workload) -> int:
    return math.isqrt(workload.splats.shN.shape[1] + 1) - 1


def _clip(workload: Workload) -> Float[Tensor, "4 4"]:
    """Camera space to clip space as in Inria's trainer, with the camera's own principal point."""
    camera, near = workload.camera, SETTINGS["near"]
    rows = [
        [2 * camera.fx / camera.width, 0, 2 * camera.cx / camera.width - 1, 0],
        [0, 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1, 0],
        [0, 0, _FAR / (_FAR - near), -_FAR * near / (_FAR - near)],
        [0, 0, 1, 0],
    ]
    return workload.splats.means.new_tensor(rows)
