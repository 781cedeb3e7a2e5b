"""The pages of the documentation: their fenced blocks, and the commands in them."""

import importlib.util
import itertools
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
OURS = ("clear_strategies", "rasterizers", "integration")


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def loaded(path: Path) -> ModuleType:
    """A Python file of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(f"docs_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(path.parent))  # as Python and mkdocs do
    spec.loader.exec_module(module)
    sys.path.remove(str(path.parent))
    return module


GENERATE = loaded(DOCS / "generate.py")


def blocks(page: Path, *languages: str) -> list[str]:
    """The fenced blocks of these languages; those inside lists are dedented, signatures of a reference left out."""
    text = GENERATE.API.sub("", page.read_text())
    found = re.findall(rf"^( *)```(?:{'|'.join(languages)})\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


def commands(block: str) -> Iterator[list[str]]:
    """The words of every simple command of a shell block, without variables set before it and redirections after it."""
    for line in block.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        words: list[str] = []
        for word in itertools.chain(lexer, [";"]):
            if set(word) <= set(";&|"):
                redirected = next((i for i, w in enumerate(words) if set(w) <= set("<>&")), len(words))
                words = words[:redirected]
                while words and (words[0] == "do" or re.fullmatch(r"\w+=.*", words[0])):
                    words = words[1:]
                if words:
                    yield words
                words = []
            else:
                words.append(word)
