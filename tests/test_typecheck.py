"""The run-time type checks of the tests refuse what the annotations do."""

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import torch
import typecheck
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float
from torch import Tensor

from rasterizers.testing import scene

hooked = typecheck.checked_once(typechecker=typecheck.check)


@hooked
def product(a: Float[Tensor, "n k"], b: "Float[Tensor, 'k m']", factor: float = 1.0) -> Float[Tensor, "n m"]:
    return factor * (a @ b).flatten(0, int(factor < 0))


@hooked
@dataclass
class Pair:
    a: Float[Tensor, " n"]
    b: "Float[Tensor, ' n'] | Nobody"  # noqa: F821

    def halves(self) -> Iterator[Tensor]:
        yield from (self.a, self.b)


def test_sizes_of_one_name_and_types_are_those_of_the_annotations():
    a, b = torch.rand(2, 3), torch.rand(3, 4)
    assert product(a, b, 2).shape == (2, 4)
    of_another_shape = (a, b, -1.0)  # what it returns
    for wrong in ((b, b), (a, b, "2"), (a, b[0]), (a.double(), b.int()), of_another_shape):
        with pytest.raises(BeartypeCallHintViolation):
            product(*wrong)
    assert len([*Pair(a[0], None).halves()]) == 2  # a name that is not there is not checked
    with pytest.raises(BeartypeCallHintViolation):
        Pair(a, None)


def test_the_packages_are_checked():
    splats = scene(20)
    with pytest.raises(BeartypeCallHintViolation, match="size of dimension"):
        type(splats)(splats.means, splats.quats[1:], splats.scales, splats.opacities, splats.sh0, splats.shN)
