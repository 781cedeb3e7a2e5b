"""Who may import whom: the picture in docs/explanation/architecture.md, kept true."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.floors import DOORS, FLOORS

ROOT = Path(__file__).resolve().parents[1]

HEAVY = {"cv2", "kornia", "open3d", "PIL", "warp", "gsplat", "hydra", "omegaconf"}


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def unit(path: Path) -> str:
    """The file, or the folder of the package, that a module belongs to."""
    parts = path.relative_to(ROOT / "clear_strategies").parts
    return parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", modules("clear_strategies"), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    me = unit(path)
    if me == "__init__" or me in DOORS or path.name == "testing.py":  # contracts may look at everything
        return
    assert me in FLOORS, f"{me} stands on no floor; add it to FLOORS"
    for name in imports(path):
        if not name.startswith("clear_strategies."):
            continue
        parts = name.split(".")
        assert parts[1] == me or parts[1] in FLOORS[me][0], f"{me} imports {name}"
        if me == parts[1] == "strategies" and path.stem not in ("__init__", "testing"):
            assert parts[2] in (path.stem, "base"), f"strategies are mutually blind, but {path.stem} imports {name}"


@pytest.mark.parametrize("path", modules("clear_strategies"), ids=lambda p: str(p.relative_to(ROOT)))
def test_heavy_libraries_stay_in_their_rooms(path):
    me = unit(path)
    allowed = DOORS[me] if me in DOORS else FLOORS[me][1] if me in FLOORS else set()
    for name in imports(path):
        library = name.split(".")[0]
        assert library not in HEAVY or library in allowed, f"{me} imports {name}"


@pytest.mark.parametrize("path", modules("clear_strategies"), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_concrete_rasterizer_is_imported(path):
    allowed = ("rasterizers.interface", "rasterizers.geometry", "rasterizers.native", "rasterizers.warp_runtime")
    for name in imports(path):
        if name.startswith("rasterizers.") and path.name != "testing.py":
            assert name.startswith(allowed), f"{path.name} imports {name}"


@pytest.mark.parametrize("path", modules("rasterizers"), ids=lambda p: str(p.relative_to(ROOT)))
def test_rasterizers_stand_alone(path):
    assert not any(name.startswith("clear_strategies") for name in imports(path))


def test_importing_the_library_is_light():
    code = (
        "import sys, clear_strategies, rasterizers; "
        "print([m for m in ('warp', 'hydra', 'cv2', 'open3d', 'kornia', 'skimage', 'matplotlib') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "path", [*modules("clear_strategies"), *modules("rasterizers")], ids=lambda p: str(p.relative_to(ROOT))
)
def test_nothing_dangerous_is_called(path):
    """No pickles, no eval, no assert as a check."""
    tree = ast.parse(path.read_text())
    if path.name != "testing.py":
        assert "pickle" not in imports(path)
    calls = {n.func.id for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}
    assert not calls & {"eval", "exec", "print"}
    assert not any(isinstance(n, ast.Assert) for n in ast.walk(tree))
    keywords = {k.arg for n in ast.walk(tree) if isinstance(n, ast.Call) for k in n.keywords}
    assert "allow_pickle" not in keywords
