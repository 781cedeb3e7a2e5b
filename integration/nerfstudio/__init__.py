"""The nerfstudio method `clear-splatfacto`.

nerfstudio finds `clear_splatfacto` by this package's entry point, or by the variable NERFSTUDIO_METHOD_CONFIGS. nerfstudio
is imported only when that name is read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from integration.nerfstudio.method import clear_splatfacto

__all__ = ["clear_splatfacto"]


def __getattr__(name: str) -> Any:
    if name == "clear_splatfacto":
        from integration.nerfstudio.method import clear_splatfacto

        return clear_splatfacto
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
