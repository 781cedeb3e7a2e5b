"""`clear_strategies` from Python: its names, what `train` returns, a package with its own strategy, and what imports bring."""

import ast
import importlib
import subprocess
import sys
import tomllib
from dataclasses import replace
from importlib import import_module, metadata
from pathlib import Path

import pytest
import torch
from packaging.requirements import Requirement

import clear_strategies
import clear_strategies as cs
from clear_strategies.compose import conductor
from clear_strategies.errors import DataError, SettingError
from clear_strategies.options import OPTIONS
from tests.helpers.command_line import TINY, started
from tests.helpers.paths import ROOT


def test_the_names_are_the_same_in_all_three_places_and_another_is_an_attribute_error():
    """For type checkers and editors, for `import *`, and for the import itself."""
    tree = ast.parse((ROOT / "clear_strategies" / "__init__.py").read_text())
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in guarded.body for alias in node.names}
    assert seen == clear_strategies._HOMES
    assert sorted(seen) == sorted(clear_strategies.__all__)
    with pytest.raises(AttributeError, match="module 'clear_strategies' has no attribute 'GCCO'"):
        _ = clear_strategies.GCCO
    with pytest.raises(ImportError, match="cannot import name 'GCCO'"):
        from clear_strategies import GCCO  # noqa: F401


@pytest.mark.parametrize("name", clear_strategies.__all__)
def test_a_name_is_that_of_its_module(name):
    found = getattr(clear_strategies, name)
    assert found is getattr(import_module(clear_strategies._HOMES[name]), name)
    assert name in dir(clear_strategies)


@pytest.mark.parametrize("package", ["clear_strategies", "rasterizers", "integration"])
def test_mypy_takes_the_types_of_the_packages_where_they_are_installed(package):
    """`mypy` itself, in the gate, checks tests/helpers/users_file.py against them."""
    assert (ROOT / package / "py.typed").is_file()


@pytest.mark.parametrize(
    ("system", "machine", "named"),
    [
        ("linux", "x86_64", {"open3d-cpu", "pycolmap"}),
        ("linux", "aarch64", set()),
        ("darwin", "arm64", {"open3d", "pycolmap"}),
    ],
)
def test_the_extras_name_only_what_has_a_wheel_for_the_system(system, machine, named):
    """Of pycolmap and of both Open3D there is no source on PyPI either: pip would install nothing of [photos] and [dev]."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = [Requirement(line) for extra in ("open3d", "colmap") for line in extras[extra]]
    where = {"sys_platform": system, "platform_machine": machine}
    assert {each.name for each in wanted if each.marker is None or each.marker.evaluate(where)} == named


# ---- training from Python: what `train` returns
@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> cs.Run:
    folder = tmp_path_factory.mktemp("notebook") / "run"
    threads = torch.get_num_threads()
    made = cs.train(None, *TINY, "fit.checkpoint_every=0", "prior=bicubic", folder=folder)
    assert torch.get_num_threads() == threads
    return made


def test_a_run_has_its_numbers_and_its_gaussians_by_gsplats_names_and_renders_from_anywhere(run: cs.Run) -> None:
    n = run.metrics["gaussians"]
    widths = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (3, 3)}
    assert {name: tuple(rows.shape) for name, rows in run.splats.items()} == {k: (n, *w) for k, w in widths.items()}
    assert {"pseudo_views", "fading_opacity"} <= set(run.metrics["strategies"])  # best, unless another is chosen
    assert {"+strategy=best", "prior=bicubic"} <= set(run.metrics["overrides"])
    assert "threads" in (run.folder / "run.log").read_text()  # a line that the console shows with -v alone
    camera = run.cameras[0]
    picture = run.render()
    assert picture.shape == (camera.height, camera.width, 3)
    pose = camera.world_to_camera.clone()
    pose[0, 3] += 0.3
    moved = run.render(replace(camera, world_to_camera=pose))
    assert not torch.equal(moved, picture)


def test_a_run_is_found_after_the_working_directory_has_changed(run: cs.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.folder.parent)
    again = cs.Run(Path(run.folder.name))
    monkeypatch.chdir(run.folder.parent.parent)
    assert torch.equal(again.render(), run.render())


def test_a_folder_without_a_finished_run_and_a_wrong_setting_are_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no run has finished here"):
        cs.Run(tmp_path)
    with pytest.raises(SettingError, match=r"fit\.iteration: .* Did you mean fit\.iterations\?"):
        cs.train(None, "fit.iteration=3", folder=tmp_path / "run")
    with pytest.raises(SettingError, match=r"data\.save_lr: must be null, since .* on the command line"):
        cs.train(None, f"data.save_lr={tmp_path / 'lr'}", folder=tmp_path / "run")
    for key, value in (("hydra.run.dir", tmp_path / "elsewhere"), ("hydra/launcher", "basic")):
        with pytest.raises(SettingError, match=rf"{key}: must be left out, .*folder=… is for its files"):
            cs.train(None, "fit.iterations=1", f"{key}={value}", folder=tmp_path / "run")
    assert not (tmp_path / "lr").exists()
    assert not (tmp_path / "run").exists()
    with pytest.raises(SettingError, match="is not there"):
        cs.train(tmp_path / "nothing")


# ---- docs/template, a package with a strategy of its own, works when it is installed
TEMPLATE = ROOT / "docs" / "template"


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, points: dict[str, str]) -> None:
    """What pip leaves for a package with these entry points."""
    info = folder / "clear_veto-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: clear-veto\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(f"[{OPTIONS}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()))
    monkeypatch.syspath_prepend(folder)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((TEMPLATE / "pyproject.toml").read_text())["project"]
    install(tmp_path / "site", monkeypatch, project["entry-points"][OPTIONS])
    monkeypatch.syspath_prepend(TEMPLATE)


def test_its_own_tests_pass_it_trains_by_its_name_and_composes_with_others(installed: None, tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("test_veto", TEMPLATE / "tests" / "test_veto.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    tests = [getattr(module, name) for name in dir(module) if name.startswith("test_")]
    assert len(tests) == 2
    for test in tests:
        test()
    of_veto = ("+strategy=[veto,svs]", "strategies.veto.start=5", "prior=bicubic")
    run = cs.train(None, *TINY, *of_veto, folder=tmp_path / "run")
    assert run.metrics["strategies"] == ["veto", "svs"]
    assert run.metrics["config"]["strategies.veto.start"] == 5
    (veto, _) = conductor("veto,svs", iterations=1_000).strategies
    assert (type(veto).__name__, veto.start) == ("Veto", 200)


def test_an_entry_point_without_a_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, {"lost": "nowhere.conf"})
    with pytest.raises(SettingError, match=r"lost = 'nowhere.conf'.*pip show -f clear-veto"):
        conductor("clear")


# ---- importing the library, an adapter or the geometry brings no heavy library into the host
HEAVY = {
    *["cv2", "gsplat", "hydra", "kornia", "matplotlib", "msgspec", "nerfstudio", "open3d", "scipy", "skimage", "warp"]
}
HOSTS = [f"integration.{host}" for host in ("gsplat", "inria", "nerfstudio")]
MODULES = ["clear_strategies", "rasterizers", "integration", *HOSTS, "clear_strategies.geometry"]


def test_the_version_is_that_of_the_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    assert clear_strategies.__version__ == metadata.version("clear-strategies")
    monkeypatch.setattr(metadata, "version", lambda name: metadata.distribution(f"no-{name}").version)
    assert clear_strategies.__version__ == "source checkout"


def test_importing_is_light_and_of_the_package_alone_imports_no_torch():
    code = (
        "import importlib, sys\n"
        "import clear_strategies as cs\n"
        "assert 'GCO' in dir(cs) and cs.DataError\n"
        "assert 'torch' not in sys.modules\n"
        f"for module in {MODULES}:\n"
        "    importlib.import_module(module)\n"
        f"    assert not sys.modules.keys() & {HEAVY}, module\n"
        "from clear_strategies import *\n"
        "assert GCO is cs.GCO\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("arguments", [["+strategy=clear"], ["train", "."]])
def test_training_without_what_it_needs_says_what_to_install(arguments, tmp_path):
    missing = HEAVY - {"gsplat", "hydra", "nerfstudio", "open3d", "warp"}
    code = (
        f"import sys; sys.modules |= dict.fromkeys({missing}); sys.argv = ['clear-strategies', *{arguments}]; "
        "from clear_strategies.run import main; main()"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert ran.returncode == 2, ran.stderr
    assert ran.stderr == f"training needs {', '.join(sorted(missing))}: pip install 'clear-strategies[train]'.\n"


@pytest.mark.slow
def test_messages_are_shown_where_the_host_has_not_configured_logging(tmp_path):
    setup, said = (
        "logging.basicConfig(format='theirs %(message)s', level='INFO')",
        "logging.getLogger('integration.x').info('said')",
    )
    alone = f"import logging; from clear_strategies.console import show_in_host; show_in_host(); {said}"
    configured = alone.replace("show_in_host();", f"{setup}; show_in_host();")
    for name, code, shown in (("alone", alone, "[clear] said\n"), ("configured", configured, "theirs said\n")):
        assert started("-c", code, cwd=tmp_path, said=tmp_path / name).wait() == 0
        assert (tmp_path / name).read_text() == shown
    beside_bar = f"from tqdm import tqdm; bar = tqdm(total=9); {alone}"
    assert started("-c", beside_bar, cwd=tmp_path, said=tmp_path / "beside a bar").wait() == 0
    assert "[clear] said" in (tmp_path / "beside a bar").read_text().splitlines()
