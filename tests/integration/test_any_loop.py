"""Whatever the loop: the gradient is right, or the step is refused and says why. Loops are put together of parts."""

import re
from contextlib import nullcontext

import pytest
import torch
from torch.nn.parallel import DistributedDataParallel

from clear_strategies.core.gradients import PARAMETERS
from integration import HostError
from tests.helpers.backends import needs
from tests.helpers.loops import PASSES, Loop, Running, of_any_two_parts, ordinary_but_for_one

pytestmark = needs("cpp")
STEPS = 2
NOTHING = "first optimizer step, but no backward() has given"


def require_right(loop: Loop, caplog) -> None:
    """Each step has the gradient of plain autograd and Eq. 8, or the refusal that the loop's parts are meant to have."""
    running, refusal = Running(loop), loop.refusal()
    with pytest.raises(HostError, match=f"{refusal}|{re.escape(NOTHING)}") if refusal else nullcontext():
        for number in range(STEPS):
            try:
                brought = running.step(number)
            except AssertionError as error:
                raise AssertionError(f"step {number} of {loop}: {error}") from error
            except HostError as error:
                if refusal or number or NOTHING not in str(error):
                    raise
                break  # no step has brought a gradient of a Gaussian
            assert ("no strategy takes part" in caplog.text) == (not brought), loop
    running.clear.remove()


def differences(loop: Loop) -> str:
    return ", ".join(f"{name}: {x}" for name, x in vars(loop).items() if x != getattr(Loop(), name)) or "ordinary"


@pytest.mark.parametrize("loop", ordinary_but_for_one(), ids=differences)
def test_a_loop_that_is_ordinary_but_for_one_part_has_the_merged_gradient_or_is_refused(loop, caplog):
    require_right(loop, caplog)


@pytest.mark.slow
@pytest.mark.parametrize("fourth", range(4))
def test_loops_in_which_any_two_parts_meet(fourth, caplog):
    for loop in of_any_two_parts()[fourth::4]:
        caplog.clear()
        require_right(loop, caplog)


class Given(torch.nn.Module):
    """A model that returns what it gets."""

    def __init__(self, parameters):
        super().__init__()
        self.own = torch.nn.ParameterList(parameters)

    def forward(self, loss):
        return loss


@pytest.mark.parametrize("as_view", [False, True])
def test_what_data_parallel_writes_when_a_pass_ends_is_merged(as_view, tmp_path, monkeypatch):
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/group", rank=0, world_size=1)
    try:
        running = Running(Loop(zeros=as_view))
        own = [running.splats[name] for name in PARAMETERS]
        parallel = DistributedDataParallel(Given(own), gradient_as_bucket_view=as_view)
        monkeypatch.setitem(
            PASSES, "one", lambda loss, p: (parallel(loss) if p["means"] is own[0] else loss).backward()
        )
        for number in range(STEPS):
            running.step(number)
        running.clear.remove()
    finally:
        torch.distributed.destroy_process_group()
