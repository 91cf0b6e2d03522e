"""The README keeps its word: its Python runs, its commands exist, its files are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from terrella.library import BUNDLED

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("number", range(len(SNIPPETS)))
def test_the_python_of_the_readme_runs(number, tmp_path, monkeypatch):
    snippet = SNIPPETS[number]
    monkeypatch.chdir(tmp_path)
    if '"doom-maze")' in snippet and not (BUNDLED / "doom-maze" / "world.json").is_file():
        pytest.skip("the bundled world doom-maze is not in this checkout, so README's Python did not run")
    exec(compile(snippet, f"README.md, snippet {number}", "exec"), {})


def test_there_is_python_to_run():
    assert len(SNIPPETS) >= 2


def test_the_commands_of_the_readme_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"^    make (\w+)", README, re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"README says `make {target}`, the Makefile has none"


def test_the_files_that_the_readme_links_are_there():
    for link in re.findall(r"\]\(([\w./-]+)\)", README):
        assert (ROOT / link).exists(), f"README links {link}"
