"""Who may import whom: the picture in docs/architecture.md, kept true."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FLOORS = [
    {
        "errors",
        "files",
        "images",
        "kernels",
        "late",
        "schedules",
        "gradients",
        "evidence",
        "ledger",
        "lock",
        "provenance",
    },
    {"strategy"},
    {"gco", "p2g", "svs", "splatsure"},
    {"objective", "conductor"},
    {"compose"},
    {"data", "mip", "optim", "field", "fused", "density", "density_gsplat", "mcmc", "skips"}
    | {"checkpoint", "metrics", "pictures", "fit", "export", "diagnosis"},
    {"run", "plan", "results", "sweep", "report", "bench", "testing"},
]
# Types that floor 2 may name: what a view is, and nothing that trains on it.
ALLOWED_UP = {("p2g", "data"), ("conductor", "data")}
HYDRA = {"run", "compose"}
HEAVY = {
    "cv2": {"data"},
    "kornia": {"data"},
    "open3d": {"data"},
    "PIL": {"data", "images"},
    "warp": {"kernels"},
    "gsplat": {"mcmc"},  # which nothing imports: a configuration names it
}
HEAVY |= {"hydra": HYDRA, "omegaconf": HYDRA}


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


def floor(name: str) -> int | None:
    return next((i for i, names in enumerate(FLOORS) if name in names), None)


@pytest.mark.parametrize("path", modules("clear_strategies"), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    me = unit(path)
    if me == "__init__":
        return
    mine = floor(me)
    assert mine is not None, f"{me} stands on no floor; add it to FLOORS"
    for name in imports(path):
        if not name.startswith("clear_strategies."):
            continue
        other = name.split(".")[1]
        theirs = floor(other)
        if theirs is None or other == me or (me, other) in ALLOWED_UP:
            continue
        assert theirs <= mine, f"{me} (floor {mine}) imports {other} (floor {theirs})"
        assert not (mine == 2 and theirs == 2), f"strategies are mutually blind, but {me} imports {other}"


@pytest.mark.parametrize("path", modules("clear_strategies"), ids=lambda p: str(p.relative_to(ROOT)))
def test_heavy_libraries_stay_in_their_rooms(path):
    for name in imports(path):
        rooms = HEAVY.get(name.split(".")[0])
        assert rooms is None or unit(path) in rooms, f"{unit(path)} imports {name}"


@pytest.mark.parametrize("path", modules("clear_strategies"), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_concrete_rasterizer_is_imported(path):
    allowed = ("rasterizers.interface", "rasterizers.geometry", "rasterizers.native", "rasterizers.warp_backend.launch")
    for name in imports(path):
        if name.startswith("rasterizers.") and unit(path) != "testing":
            assert name.startswith(allowed), f"{unit(path)} imports {name}"


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
