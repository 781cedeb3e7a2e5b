"""The formats that `formats` writes, for whoever only lists them."""

from __future__ import annotations

from typing import Final

FORMATS: Final = {
    "ply": "the standard layout of 3DGS; nothing is lost",
    "splat": "32 bytes a Gaussian, 8-bit colours that do not depend on the direction",
    "glb": "binary glTF with Khronos' KHR_gaussian_splatting: nothing is lost; points for viewers without the extension",
    "spz": "Niantic's, version 4: a tenth of the PLY, the strong view-dependent colour included",
    "sog": "PlayCanvas's: a fifth of the PLY, view-dependent colour included; slow for large splats",
}
