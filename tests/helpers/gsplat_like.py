"""A densifier of gsplat's shape, small enough to reckon with, for where gsplat is not installed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn


@dataclass
class Tiny:
    """Clones what passes `grow_grad2d` a little to the side, removes what is faint, resets opacities now and then."""

    grow_grad2d: float = 2e-4
    refine_start_iter: int = 500
    refine_stop_iter: int = 5_000
    refine_every: int = 100
    reset_every: int = 3_000
    prune_opa: float = 0.005
    wander: float = 0.1
    steps: list[int] = field(default_factory=list)
    infos: list[dict[str, Any]] = field(default_factory=list)

    def check_sanity(self, params, optimizers):
        assert set(params) == set(optimizers)
        assert all(len(o.param_groups) == 1 for o in optimizers.values())

    def initialize_state(self, scene_scale: float = 1.0):
        return {"grad2d": None, "count": None, "rounds": 0, "scene_scale": scene_scale}

    def step_pre_backward(self, params, optimizers, state, step, info):
        info["means2d"].retain_grad()

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        self.steps.append(step)
        self.infos.append(info)
        if step >= self.refine_stop_iter:
            return
        ndc = info["means2d"].grad[0] * torch.tensor([info["width"] / 2, info["height"] / 2])
        seen = info["radii"][0].reshape(len(ndc), -1).amax(1) > 0
        if state["count"] is None:
            state["grad2d"], state["count"] = torch.zeros(len(seen)), torch.zeros(len(seen))
        state["grad2d"] += torch.where(seen, ndc.norm(dim=1), 0.0)
        state["count"] += seen
        if step > self.refine_start_iter and step % self.refine_every == 0:
            self._round(params, optimizers, state)
        if step % self.reset_every == 0:
            low = params["opacities"].clamp_max(-4.6)
            _rewrite(params, optimizers, {"opacities": lambda _: low}, torch.zeros_like)

    def _round(self, params, optimizers, state):
        chosen = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        keep = params["opacities"].sigmoid() >= self.prune_opa
        rows = torch.arange(len(chosen))
        parents = torch.cat((rows[keep & chosen], rows[keep]))  # the new ones first, so that every row moves
        fresh = int((keep & chosen).sum())

        def gathered(v):
            return v[parents]

        def rested(v):
            return torch.cat((torch.zeros_like(v[parents[:fresh]]), v[parents[fresh:]]))

        _rewrite(params, optimizers, dict.fromkeys(params, gathered), rested)
        params["means"].data[:fresh] += self.wander * torch.randn(fresh, 3)
        for name, value in state.items():
            if isinstance(value, torch.Tensor):
                state[name] = value[parents]
        state["grad2d"].zero_()
        state["count"].zero_()
        state["rounds"] += 1


class Blind(Tiny):
    """Reads no screen gradient."""

    def step_pre_backward(self, params, optimizers, state, step, info):
        pass

    def step_post_backward(self, params, optimizers, state, step, info, lr):
        self.steps.append(step)
        params["means"].add_(lr * torch.randn_like(params["means"]))


class Careless(Tiny):
    """Rewrites the parameters that it knows by name, and forgets the others."""

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        _rewrite(params, optimizers, {"means": lambda p: p[1:]}, lambda v: v[1:])


class Greedy(Tiny):
    """Asks for what this trainer does not have."""

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        info["conics"]


class Emptying(Tiny):
    """Removes all but the first."""

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        _rewrite(params, optimizers, dict.fromkeys(params, lambda p: p[:1]), lambda v: v[:1])


def _rewrite(params, optimizers, of_parameter, of_moments):
    for name, change in of_parameter.items():
        old = params[name]
        new = nn.Parameter(change(old.detach()))
        moments = optimizers[name].state.pop(old)
        optimizers[name].state[new] = {k: v if k == "step" else of_moments(v) for k, v in moments.items()}
        optimizers[name].param_groups[0]["params"] = [new]
        params[name] = new
