"""The nerfstudio method `clear-splatfacto`.

nerfstudio finds `clear_splatfacto` by this package's entry point, or by the variable NERFSTUDIO_METHOD_CONFIGS. nerfstudio
is imported only when that name is read.
"""

import importlib
from typing import Any


def __getattr__(name: str) -> Any:
    if name != "clear_splatfacto":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # It reads the methods of its plugins, this one among them, when its own are defined.
    importlib.import_module("nerfstudio.configs.method_configs")
    from integration.nerfstudio.method import specification

    return specification()
