"""Peers on CUDA, as far as a CPU can show it: each is called with its own conventions and compared by its own rules."""

from __future__ import annotations

from collections import namedtuple
from functools import partial
from importlib import metadata

import pytest
import torch

import rasterizers
from clear_strategies.bench import accuracy, peers, scenes
from clear_strategies.bench import rasterizers as drawing
from rasterizers import Camera, Splats, autograd


@pytest.fixture(scope="module")
def tiny() -> scenes.Workload:
    return scenes.load("tiny")


def errors(peer: peers.Peer, workload: scenes.Workload, **rules: object) -> dict[str, float]:
    v = drawing.random_cotangents(workload)[0]
    truth = accuracy.truth("torch", workload, v, {**peer.rules, **rasterizers.PRESETS[peers.PRESET], **rules})
    return accuracy.errors(accuracy.draw(drawing.peer_on(workload, peer).render, v), truth)


def test_gsplat_is_called_with_its_conventions(tiny):
    peer = peers.gsplat(partial(autograd.rasterization, backend="torch"), "stand-in")
    assert not peer.rules
    found = errors(peer, tiny, alpha_max=0.99)  # the stand-in's cap
    assert found["image_p99.99"] < 1e-5
    assert max(found[f"{name}_relative"] for name in accuracy.ATTRIBUTES) < 1e-3


class Inria:
    """A library with the interface of Inria's rasterizer and gswarp, around our reference."""

    GaussianRasterizationSettings = namedtuple(
        "GaussianRasterizationSettings",
        "image_height image_width tanfovx tanfovy bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered "
        "auto_tune_verbose",
    )

    class GaussianRasterizer:
        def __init__(self, settings) -> None:
            self.s = settings

        def __call__(self, means3D, means2D, opacities, dc, shs, scales, rotations):
            s = self.s
            camera = Camera(
                s.viewmatrix.T, s.image_width / 2 / s.tanfovx, s.image_height / 2 / s.tanfovy, s.image_width / 2,
                s.image_height / 2, s.image_width, s.image_height,
            )  # fmt: skip
            torch.testing.assert_close(camera.center, s.campos)
            assert torch.allclose(rotations.norm(dim=-1), torch.ones(len(rotations)))
            own = {"kernel": 0.3, "near": 0.2, "alpha_max": 0.99, "antialiased": False, "preset": "fast"}
            splats = Splats(means3D, rotations, scales, opacities[:, 0], dc, shs)
            drawn = autograd.draw(rasterizers.load("torch", **own), splats, camera)
            clip = torch.cat((means3D.detach(), torch.ones(len(means3D), 1)), 1) @ s.projmatrix
            ndc = clip[:, :2] / clip[:, 3:]
            centers = ((ndc + 1) * torch.tensor([s.image_width, s.image_height]) - 1) / 2 + 0.5
            visible = drawn.visible
            torch.testing.assert_close(centers[visible], drawn.means2d.detach()[visible], atol=1e-3, rtol=1e-4)
            return drawn.image.movedim(-1, 0), None, None


def test_gswarp_is_called_with_its_conventions_and_compared_by_its_rules(tiny):
    found = errors(peers.gswarp(Inria, "stand-in"), tiny)
    assert found["image_p99.99"] < 1e-5
    assert max(found[f"{name}_relative"] for name in accuracy.ATTRIBUTES) < 1e-3


def test_k_cotangents_are_k_backward_passes(tiny):
    cotangents = drawing.random_cotangents(tiny)
    contestant = drawing.peer_on(tiny, peers.gswarp(Inria, "stand-in"))
    assert list(drawing.turn(contestant, cotangents)) == [drawing.FORWARD, *drawing.BACKWARD]
    rendering = contestant.render()
    both, second = rendering.vjp(cotangents[:2]), rendering.vjp(cotangents[1:2])
    torch.testing.assert_close(both.means[1], second.means[0])


def test_missing_and_broken_peers_are_noted_in_a_line_each(monkeypatch):
    def version(name: str) -> str:
        if name == "gsplat":
            raise metadata.PackageNotFoundError(name)
        raise RuntimeError("no compiler\nand a long story")

    monkeypatch.setattr(metadata, "version", version)
    notes = []
    assert peers.available(notes.append) == []
    assert notes == ["gsplat: not installed (pip install gsplat).", "gswarp: cannot be used (no compiler)."]
