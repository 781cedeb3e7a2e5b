"""An adapter of one's own, as docs/how-to/own-host.md shows it, and what is refused where it is written in another way."""

from dataclasses import replace

import pytest
import torch

from clear_strategies import SVS, Conductor
from clear_strategies.errors import SettingError
from integration import HostError
from integration.attachment import Attachment
from integration.autograd_shot import HostOutput
from integration.host import Host
from tests.helpers import gsplat_host, toy
from tests.helpers.host_parts import HR_FROM_START, shot_of


class Adapter:
    """A host, and the three things that an `Attachment` needs of it."""

    def __init__(self, params=lambda p: p, parents=lambda: None):
        self.scene = toy.scene(20)
        self.splats = gsplat_host.Host(self.scene).splats
        host = Host(lambda: params(self.splats), parents)
        self.attachment = Attachment(Conductor(objective=HR_FROM_START), host, self.scene.train)

    def render_at(self, target, gate, view):
        p, camera = self.splats, view.lr.camera if target == "lr" else view.hr.camera
        shot = shot_of(p, camera, p.get("detail") if target == "hr" else None)
        return HostOutput(shot, shot.image, [shot.image])

    def step(self, change=lambda output: output):
        def render_at(*asked):
            return change(self.render_at(*asked))

        self.attachment.render_view(self.scene.train[0], render_at).mean().backward()
        return self.attachment.counts["merges"]


def test_a_process_that_joins_others_after_the_attachment_is_refused(monkeypatch):
    adapter = Adapter()
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    with pytest.raises(SettingError, match="CLEAR trains in one process, got 2"):
        adapter.step()


def test_a_mask_for_each_scale_is_refused():
    with pytest.raises(SettingError, match="SVS: other trainers render both scales with one mask"):
        gsplat_host.started(SVS(shared=False))


def activated(output):
    p = output.shot.params
    return replace(output, shot=replace(output.shot, params={**p, "scales": p["scales"].exp()}))


def marked(output):
    return replace(output, marks=[output.shot.params["means"]])


def test_it_merges_until_it_is_removed():
    adapter = Adapter()
    assert adapter.step() == 1
    adapter.attachment.remove()
    assert adapter.step() == 1


def test_a_hook_on_f_det_is_called_once_with_its_merged_gradient():
    found = []
    for factor in (1, 3):
        adapter = Adapter()
        detail = adapter.splats["detail"] = torch.nn.Parameter(torch.zeros(20, 3))
        detail.register_hook(lambda g, factor=factor: factor * g)
        adapter.step()
        found.append(detail.grad)
    assert found[0].any()
    torch.testing.assert_close(found[1], 3 * found[0], atol=0, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "error", "rule"),
    [
        (lambda output: output.returned, TypeError, "render_at must return a HostOutput for 'hr', got Tensor"),
        (activated, HostError, "must hold the parameters themselves, got other tensors as scales"),
        (marked, HostError, "a mark of view0 is a leaf.*Mark what the loop gets"),
    ],
)
def test_another_output_is_refused(change, error, rule):
    with pytest.raises(error, match=rule):
        Adapter().step(change)


@pytest.mark.parametrize(
    "change", [lambda p: {k: x for k, x in p.items() if k != "shN"}, lambda p: {"xyz": p["means"]}]
)
def test_parameters_of_other_names_are_refused(change):
    with pytest.raises(
        HostError, match="params must return means, quats, scales, opacities, sh0, shN, got none of the name"
    ):
        Adapter(change)


def test_rows_that_come_from_none_and_optimizers_in_a_dict_are_refused():
    with pytest.raises(HostError, match="comes from row 39, but had 20 rows"):
        Adapter(parents=lambda: torch.arange(20) + 20).step()
    with pytest.raises(HostError, match="says of 19 Gaussians which they come from, but has 20"):
        Adapter(parents=lambda: torch.arange(19)).step()
    adapter = Adapter()
    with pytest.raises(TypeError, match="optimizers must be a sequence, got a dict"):
        adapter.attachment.hook({"means": torch.optim.SGD([adapter.splats["means"]])})
