"""Whatever the loop: the gradient is right, or the step is refused and says why. Loops are put together of parts."""

import re
from contextlib import nullcontext

import pytest

from integration import HostError
from tests.helpers.backends import needs
from tests.helpers.loops import Loop, Running, of_any_two_parts, ordinary_but_for_one

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
