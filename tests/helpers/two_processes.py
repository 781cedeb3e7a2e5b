"""Two processes that train one field with `joint_loss`, each on other views, and average the gradients."""

import copy

import pytest
import torch
from torch import distributed
from torch.nn.parallel import DistributedDataParallel

from clear_strategies import GCO, P2G, SVS, Conductor
from clear_strategies.errors import SettingError
from clear_strategies.schedules import Ramp
from integration import joint_loss
from tests.helpers import gsplat_host, toy
from tests.helpers.host_parts import HR_FROM_START, shot_of

STEPS = 4


class Model(torch.nn.Module):
    def __init__(self, scene):
        super().__init__()
        self.rows = gsplat_host.Host(scene).splats
        self.rows["detail"] = torch.nn.Parameter(torch.zeros(20, 3))
        self.held = torch.nn.ParameterDict(self.rows)

    def forward(self, conductor, view, t):
        return joint_loss(conductor, self.rows, *self._both(view, conductor.gate(t, 20)), view, t)

    def _both(self, view, gate):
        gated, without = self.rows["opacities"].sigmoid() * gate, {k: x for k, x in self.rows.items() if k != "detail"}
        yield shot_of(without, view.lr.camera, opacities=gated)
        yield shot_of(self.rows, view.hr.camera, self.rows["detail"], opacities=gated)


def train(rank: int, file: str) -> None:
    """What each of the two does; an error ends both."""
    distributed.init_process_group("gloo", init_method=f"file://{file}", rank=rank, world_size=2)
    try:
        scene = toy.scene(20)
        model = Model(scene)
        parallel = DistributedDataParallel(copy.deepcopy(model))
        ends = [trained(model, model, scene, rank), trained(parallel.module, parallel, scene, rank)]
        assert all(torch.allclose(mine, theirs, atol=1e-6) for mine, theirs in zip(*ends, strict=True))
        with pytest.raises(SettingError, match=r"one process, got 2.*Or average the gradients of joint_loss"):
            gsplat_host.started(GCO(), scene=scene)
        distributed.barrier()  # neither ends while the other still needs it
    finally:
        distributed.destroy_process_group()


def trained(model, called, scene, rank):
    """The parameters after training, which are those of the other process."""
    svs = SVS(Ramp(shape="constant"), looks=0, anchor_start=2, anchor_strength=0.01)
    conductor = Conductor(GCO(), P2G(), svs, objective=HR_FROM_START)
    conductor.on_fit_start(len(scene.train), seed=0, views=scene.train)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    for t in range(1, STEPS + 1):
        loss, update = called(conductor, scene.train[(t + rank) % 3], t)
        loss.backward()
        for p in model.parameters() if called is model else ():
            distributed.all_reduce(p.grad)
            p.grad /= 2
        optimizer.step()
        optimizer.zero_grad()
        conductor.after_step({name: p.detach() for name, p in model.rows.items()}, update.step)
    for p in model.parameters():
        both = [torch.empty_like(p), torch.empty_like(p)]
        distributed.all_gather(both, p.detach())
        assert torch.equal(*both)
    return [p.detach() for p in model.parameters()]
