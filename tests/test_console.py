"""The console shows the plan, the bar, the result and warnings; run.log has everything."""

import io
import logging
import re
import sys

import pytest
from tqdm import tqdm

from clear_strategies.console import Console
from tests.helpers.command_line import TINY, run

# Of every part of a run that tells details, one.
DETAILS = ["image losses: ", "reliability R", "cloned, ", "prior: auto chose"]


@pytest.fixture
def logger():
    logger = logging.getLogger("clear_strategies.tests.console")
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    yield logger
    logger.handlers.clear()


@pytest.mark.parametrize(
    ("verbose", "shown"), [(False, "plan\nwarning: odd\n"), (True, "detail\nplan\nwarning: odd\n")]
)
def test_details_are_for_those_who_ask_and_warnings_have_a_prefix(logger, verbose, shown):
    stream = io.StringIO()
    logger.addHandler(Console(stream, verbose=verbose))
    logger.debug("detail")
    logger.info("plan")
    logger.warning("odd")
    assert stream.getvalue() == shown


def test_what_libraries_say_is_not_shown_but_their_errors_are():
    console = Console(stream := io.StringIO())
    for name in ("websockets.server", "matplotlib.font_manager", "py.warnings"):
        for level in (logging.INFO, logging.WARNING, logging.ERROR):
            console.handle(logging.LogRecord(name, level, "", 0, f"{name} {level}", None, None))
    assert (
        stream.getvalue() == "error: websockets.server 40\nerror: matplotlib.font_manager 40\nerror: py.warnings 40\n"
    )


def test_pythons_warnings_do_not_reach_the_user(tmp_path):
    code = """if True:
        import warnings
        from clear_strategies import run
        run.named = lambda arguments: lambda: warnings.warn("this library has a new name")
        run.main()
    """
    done = run(cwd=tmp_path, code=code)
    assert (done.returncode, done.stderr) == (0, "")


def test_warnings_of_a_run_from_python_are_in_its_log_alone_and_others_are_shown_again(tmp_path):
    """As those of matplotlib for a scene whose name has letters that its font lacks."""
    code = f"""if True:
        import warnings
        from pathlib import Path
        from clear_strategies import console
        console.show()
        with console.logged(Path({str(tmp_path)!r}) / "run.log") as log:
            log()
            warnings.warn("Glyph 24237 missing")
        warnings.warn("the user's own")
    """
    said = run(cwd=tmp_path, code=code).stderr
    assert ("Glyph" in said, "the user's own" in said) == (False, True)
    assert "Glyph 24237 missing" in (tmp_path / "run.log").read_text()


def test_a_message_stands_on_a_line_of_its_own_above_the_bar(logger, monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    logger.addHandler(Console(screen))
    with tqdm(total=10, file=screen, mininterval=0) as bar:
        bar.update(3)
        logger.info("said")
        bar.update(3)
    lines = screen.getvalue().replace("\r", "\n").splitlines()
    assert "said" in lines
    assert "3/10" in screen.getvalue().partition("said")[2]  # the bar is drawn again below


def test_by_default_the_console_has_the_plan_the_bar_the_result_and_where_to_look_and_with_v_all_details(tmp_path):
    folder, tiny = tmp_path, ["+strategy=clear", *TINY]
    quiet, loud = (run(*tiny, f"hydra.run.dir={name}", *v, cwd=folder) for name, *v in (["quiet"], ["loud", "-v"]))
    assert quiet.returncode == loud.returncode == 0, quiet.stderr + loud.stderr
    lines = [line for line in quiet.stdout.splitlines() if not re.search(r": \d+ of \d+ ", line)]  # on a slow machine
    assert [line.split()[0] for line in lines[:4]] == ["data", "strategies", "iterations", "scene"]
    done = next(i for i, line in enumerate(lines) if line.startswith("done in"))
    assert re.fullmatch(r"done in \d+ s( \(.*\d s\))?: quiet", lines[done])
    plan = lines[:done]
    result = lines[done + 1 :]
    assert len(plan) <= 15
    assert all(line.startswith(("  ", "warning: ")) for line in plan), quiet.stdout
    assert result[-1] == "  look next: quiet/contact_sheet.jpg, or clear-strategies view quiet"
    assert sum("GMSD, the error of edges" in line for line in result) == 1
    assert not any(detail in quiet.stdout for detail in DETAILS)
    bars = quiet.stderr.splitlines()  # in a file, a line each twentieth, here each iteration
    assert len(bars) == 12
    assert all(re.match(r"clear: +\d+%\|.*\| \d+/12 \[.*(it/s|s/it)", line) for line in bars)
    log = (folder / "quiet" / "run.log").read_text()
    assert all(detail in log for detail in [*DETAILS, "done in", "scene"])
    assert all(detail in loud.stdout for detail in DETAILS)
    assert "verbose: true" in (folder / "loud" / ".hydra" / "config.yaml").read_text()
    assert len({(folder / name / "point_cloud.ply").read_bytes() for name in ("quiet", "loud")}) == 1
