"""Calls of a wrapped `rasterization`: which one is the rendering of a photo, and what else a loop draws beside it."""

from __future__ import annotations

from clear_strategies import Conductor
from integration.gsplat import attach
from tests.helpers import gsplat_host, toy
from tests.helpers.inria import HR_FROM_START
from tests.integration.test_gsplat import started


def test_a_function_is_wrapped_again_once_the_attachment_that_wrapped_it_is_removed():
    host, first, _ = started()
    wrapped = first.wrap(gsplat_host.rasterization)
    first.remove()
    scene = toy.scene(20)
    second = attach(host.splats, host.optimizers, scene.train, Conductor(objective=HR_FROM_START))
    gsplat_host.drawn(second.wrap(wrapped), host.splats, scene.train[0].lr.camera)[0].mean().backward()
    assert (first.attachment.counts["merges"], second.attachment.counts["merges"]) == (0, 1)
