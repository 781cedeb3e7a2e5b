"""What recorded work may do with the iteration and with a name, and what it must not."""

import pytest
import torch

from rasterizers.guards import Guarded, Unread, iteration, unread

READS = {
    "as a number": float,
    "as an index": lambda x: [1.0, 2.0, 3.0, 4.0][x],
    "as a key": lambda x: {4: 0.5, "view0": 0.5}.get(x, 1.0),
    "by torch": lambda x: torch.ones(1) * x,
    "beside a tensor": lambda x: torch.ones(3) < x,
    "by its own function": lambda x: x.bit_length() if isinstance(x, int) else x.endswith("0"),
}


TOLD = {"the iteration": lambda: Guarded(3, "the iteration"), "the name": lambda: Unread("view0", "the name")}


@pytest.mark.parametrize("read", READS)
@pytest.mark.parametrize("told", TOLD)
def test_what_a_replay_would_keep_is_refused(told, read):
    with pytest.raises(RuntimeError, match=f"recorded work must not read {told}, which is another one in a replay"):
        READS[read](TOLD[told]())


def test_numbers_made_of_the_iteration_are_known_at_another_one_and_it_can_be_put_into_a_message():
    t = Guarded(7, "the iteration")
    made = 10 * -(-t // 5) - 1
    assert isinstance(made, int)
    assert [made.at(7), made.at(11)] == [19, 29]
    assert (f"t={t}", t > 5, bool(t % 2)) == ("t=7", True, True)
    assert type(iteration(7)) is type(unread(7, "the seed")) is int  # nothing is recorded here
    name = Unread("view0", "the name")
    assert f"{name}: {name!r}" == "view0: view0"


def test_what_is_the_same_in_every_replay_may_be_read():
    camera = Unread(complex(3, 4), "the camera", ("real",))
    assert camera.real == 3
    with pytest.raises(RuntimeError, match="must not read the camera"):
        camera.conjugate()
