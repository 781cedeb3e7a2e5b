"""`clear_strategies` itself: its names are there as ever, and imported only when they are asked for."""

from __future__ import annotations

import ast
import pickle
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import clear_strategies

ROOT = Path(__file__).resolve().parents[1]


def test_the_names_are_written_the_same_in_all_three_places():
    """For type checkers and editors, for `import *`, and for the import itself."""
    tree = ast.parse((ROOT / "clear_strategies" / "__init__.py").read_text())
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in guarded.body for alias in node.names}
    assert seen == clear_strategies._HOMES
    assert sorted(seen) == sorted(clear_strategies.__all__)


@pytest.mark.parametrize("name", clear_strategies.__all__)
def test_a_name_is_that_of_its_module(name):
    found = getattr(clear_strategies, name)
    assert found is getattr(import_module(clear_strategies._HOMES[name]), name)
    assert name in dir(clear_strategies)


def test_a_strategy_is_pickled_by_the_module_that_defines_it():
    assert pickle.loads(pickle.dumps(clear_strategies.GCO(tolerance=0.1))) == clear_strategies.GCO(tolerance=0.1)  # noqa: S301


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'clear_strategies' has no attribute 'GCCO'"):
        _ = clear_strategies.GCCO
    with pytest.raises(ImportError, match="cannot import name 'GCCO'"):
        from clear_strategies import GCCO  # noqa: F401


def test_importing_the_package_imports_no_torch_and_a_name_what_it_needs():
    code = (
        "import sys, clear_strategies as cs; before = 'torch' in sys.modules; "
        "assert 'GCO' in dir(cs); cs.DataError; errors = 'torch' in sys.modules; "
        "from clear_strategies import *; print(before, errors, 'torch' in sys.modules, GCO is cs.GCO)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "False False True True"
