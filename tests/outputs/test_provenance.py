"""Provenance holds what can be found out, and never fails."""

from __future__ import annotations

import json
import subprocess
from importlib import metadata

import pytest
import torch

from clear_strategies.outputs.provenance import provenance


def test_provenance_holds_versions_machine_and_the_facts_of_the_run() -> None:
    found = provenance(seed=3, backend="torch")
    assert torch.__version__.startswith(found["versions"]["torch"])  # which leaves out +cu130 in PyPI's wheel
    assert found["threads"] == torch.get_num_threads()
    assert (found["seed"], found["backend"]) == (3, "torch")
    assert found["date"].endswith("+00:00")
    assert json.loads(json.dumps(found)) == found


@pytest.mark.parametrize("failure", [FileNotFoundError("git"), subprocess.TimeoutExpired("git", 10)])
def test_without_git_the_commit_is_unknown(monkeypatch: pytest.MonkeyPatch, failure: Exception) -> None:
    def fails(*arguments: object, **options: object) -> None:
        raise failure

    monkeypatch.setattr(subprocess, "run", fails)
    assert provenance()["git"] in {"unknown", "no checkout"}


def test_a_package_that_is_not_installed_is_not_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", absent)
    assert provenance()["versions"] == {"clear-strategies": "source checkout"}
