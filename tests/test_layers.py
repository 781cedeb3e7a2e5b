"""Who may import whom: the table in docs/explanation/architecture.md, kept true."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

PAGE = (ROOT / "docs" / "explanation" / "architecture.md").read_text()


def named(text: str) -> set[str]:
    return set(re.findall(r"`([^`]+)`", text))


def layers() -> dict[str, tuple[set[str], set[str]]]:
    """The folders of clear_strategies/ from the bottom: what each may import, and the heavy libraries that it may use."""
    found: dict[str, tuple[set[str], set[str]]] = {}
    for line in PAGE.split("| folder or file |")[1].split("\n\n")[0].splitlines()[2:]:
        folder, _, imported, libraries = line.split("|")[1:-1]
        allowed = named(imported) if re.match(" (only|nothing) ", imported) else found.keys() - named(imported)
        found[min(named(folder))] = allowed, named(libraries)
    return found


LAYERS = layers()
ENTRY_POINTS = {
    entry: named(own)
    for entry, own in re.findall(r"`(\w+)`(?: \((.*?)\))?", PAGE.split("The entry points")[1].split("\n\n")[0])
}

HEAVY = {"cv2", "kornia", "open3d", "PIL", "warp", "gsplat", "hydra", "omegaconf"}
PACKAGES = ("clear_strategies", "rasterizers", "integration")


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def statements(path: Path) -> list[set[str]]:
    """What each import of a file may mean, those inside functions too, but for those that only type checkers read.

    `from a import b` is the module a.b, or a name that the module a defines.
    """
    tree, found, for_types = ast.parse(path.read_text()), [], set[ast.stmt]()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for_types.update(node.body)
        elif node in for_types:
            continue
        elif isinstance(node, ast.Import):
            found += [{alias.name} for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [{node.module, f"{node.module}.{alias.name}"} for alias in node.names]
    return found


def imports(path: Path) -> set[str]:
    return set().union(*statements(path))


def unit(path: Path) -> str:
    """The file, or the folder of the package, that a module belongs to."""
    parts = path.relative_to(ROOT / "clear_strategies").parts
    return parts[0].removesuffix(".py")


def test_imports_point_down():
    for path in modules("clear_strategies"):
        me = unit(path)
        if me == "__init__" or me in ENTRY_POINTS:
            continue
        for name in imports(path):
            parts = name.split(".")
            if parts[0] != "clear_strategies" or len(parts) == 1:
                continue
            assert parts[1] == me or parts[1] in LAYERS[me][0], f"{path} imports {name}"
            if me == parts[1] == "strategies" and path.stem != "__init__":
                assert parts[2] in (path.stem, "base"), (
                    f"strategies must not import each other, but {path.stem} imports {name}"
                )


def test_every_module_is_in_a_layer_or_an_entry_point():
    units = {unit(path) for path in modules("clear_strategies")} - {"__init__"}
    assert units == LAYERS.keys() | ENTRY_POINTS.keys()


def test_a_layer_imports_lower_layers_only():
    """So there is no circle between folders."""
    below: set[str] = set()
    for folder, (allowed, _) in LAYERS.items():
        assert allowed <= below, f"{folder} is below {allowed - below}"
        below.add(folder)


def require_no_circle(graph: dict[str, set[str]]) -> None:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_no_files_import_each_other():
    files = {dotted(path): path for package in PACKAGES for path in modules(package)}
    # Of a package and a module in it, the longer name is what is imported.
    found = {
        name: {max(known, key=len) for one in statements(path) if (known := one & files.keys())}
        for name, path in files.items()
    }
    require_no_circle({name: imported - {name} for name, imported in found.items()})
    with pytest.raises(pytest.fail.Exception, match="imports"):
        require_no_circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})


def test_heavy_libraries_are_imported_only_where_the_table_names_them():
    for path in modules("clear_strategies"):
        me = unit(path)
        allowed = ENTRY_POINTS[me] if me in ENTRY_POINTS else LAYERS[me][1] if me in LAYERS else set()
        wrong = {name.split(".")[0] for name in imports(path)} & HEAVY - allowed
        assert not wrong, f"{path} imports {wrong}"


def test_packages_import_what_lies_below_them():
    """No concrete rasterizer in clear_strategies, nothing of clear_strategies in rasterizers, and hosts at the top."""
    names = "interface geometry guards modes native recording replays sending testing torch_internals warp_runtime"
    shared = tuple(f"rasterizers.{name}" for name in names.split())
    for path in modules("clear_strategies"):
        found = {name for name in imports(path) if name.startswith(("rasterizers.", "integration"))}
        wrong = {name for name in found if not name.startswith(shared)}
        assert not wrong, f"{path} imports {wrong}"
    for path in modules("rasterizers"):
        assert not any(name.startswith(("clear_strategies", "integration")) for name in imports(path)), path


def test_nothing_dangerous_is_called():
    """No pickles, no eval, no assert as a check."""
    for path in (*modules("clear_strategies"), *modules("rasterizers")):
        tree = ast.parse(path.read_text())
        assert "pickle" not in imports(path), path
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        assert not {n.func.id for n in calls if isinstance(n.func, ast.Name)} & {"eval", "exec", "print"}, path
        assert not any(isinstance(node, ast.Assert) for node in ast.walk(tree)), path
        assert not any(keyword.arg == "allow_pickle" for call in calls for keyword in call.keywords), path
