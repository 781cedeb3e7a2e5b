"""Whatever the loop: the gradient is right, or the step is refused and says why. Loops are put together of parts by chance."""

from contextlib import nullcontext

import pytest

from integration import HostError
from tests.helpers.backends import needs
from tests.helpers.loops import Running, loop_of

pytestmark = needs("cpp")
STEPS = 2


def require_right(seed: int, caplog) -> None:
    """Each step of a loop has the gradient of plain autograd and Eq. 8, or the refusal that its parts are meant to have."""
    loop = loop_of(seed)
    running = Running(loop)
    with pytest.raises(HostError, match=loop.refusal()) if loop.refusal() else nullcontext():
        for number in range(STEPS):
            try:
                brought = running.step(number)
            except AssertionError as error:
                raise AssertionError(f"step {number} of {loop}: {error}") from error
            except HostError as error:
                if number or "first optimizer step, but no backward() has given" not in str(error):
                    raise
                break  # no step has brought a gradient of a Gaussian
            assert ("no strategy takes part" in caplog.text) == (not brought), loop
    running.clear.remove()


@pytest.mark.parametrize("seed", range(60))
def test_a_step_of_any_loop_has_the_merged_gradient_or_is_refused(seed, caplog):
    require_right(seed, caplog)


@pytest.mark.slow
@pytest.mark.parametrize("hundred", range(10))
def test_a_thousand_loops(hundred, caplog):
    for seed in range(100 * hundred, 100 * hundred + 100):
        caplog.clear()
        require_right(1_000 + seed, caplog)
