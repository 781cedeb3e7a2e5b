"""The two computations of every reconciliation of gradients; its weights come from a strategy (`Strategy.reconcile`):

    products    ⟨l, h⟩, ‖l‖², ‖h‖² of every Gaussian, by attribute group
    apply       g_LR + λ_HR (keep · g_HR - remove · g_LR) + what regularizers add                  Eq. 7, 8, 16

`reference` specifies both. `cpp` computes them for float32 in the CPU's memory, `warp` on CUDA, `reference` in all other cases.
`kernels.gaussian_step` computes the same in this package's trainer, without storing gradients.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.kernels import native
from clear_strategies.kernels.reconcile import reference
from clear_strategies.kernels.reconcile.tables import WIDEST, common_groups, has
from rasterizers.native import empty_for

__all__ = ["apply", "common_groups", "dense", "has", "products"]


def products(lr: Grads, hr: Grads) -> Products:
    """The inner products of both gradients.

    Raises:
        ValueError: the gradients have no group in common.
    """
    if not (names := common_groups(lr, hr)):
        raise ValueError(
            f"the groups {', '.join(CONFLICT_GROUPS)} are compared, and no two gradients are of one: lr has "
            f"{', '.join(lr) or 'none'}, hr has {', '.join(hr) or 'none'}. Name them so."
        )
    result: Products = _chosen(*lr.tensors.values(), *hr.tensors.values()).products(lr, hr, names)
    return result


def apply(
    out: Mapping[str, Tensor], lr: Grads, hr: Grads, weights: Weights, *, lambda_hr: float | Float[Tensor, " 1"] = 1.0,
    plus: Grads | None = None, keeps_lr: bool = True,
) -> Number:  # fmt: skip
    """Write the merged gradient to `out`, by attribute; for f_det, keep is 1.

    Args:
        out: contiguous, [N, …]; it may hold the tensors of `lr`. An attribute that no gradient has becomes 0.
        lambda_hr: a tensor of the type of `out` in a recording, see `rasterizers.recording`.
        keeps_lr: False: without g_LR, only keep · g_HR - remove · g_LR.

    Returns:
        Whether the whole result is finite, 0 or 1; on a device, it is read later.
    """
    plus = Grads() if plus is None else plus
    chosen = _chosen(*out.values(), *lr.tensors.values(), *hr.tensors.values(), *plus.values())
    finite: Number = chosen.apply(out, lr, hr, weights, lambda_hr, plus, keeps_lr)
    return finite


def dense(g: Grads, like: Mapping[str, Tensor]) -> Grads:
    """The gradient in full, without factors, in the shapes of `like` and only for its attributes."""
    out = {name: g[name].reshape(x.shape) for name, x in like.items() if name in g}
    if g.colour is not None:
        bands = {name: empty_for(like[name]) for name in ("sh0", "shN") if name in like}
        apply(bands, Grads(), g, Weights(), keeps_lr=False)
        out |= bands
    return Grads(out, screen=g.screen)


def _chosen(*tensors: Tensor) -> ModuleType:
    is_wide = any(x.shape[1:].numel() > WIDEST for x in tensors)
    return reference if is_wide else native.implementation(__name__, *tensors)
