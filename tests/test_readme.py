"""The README and the guides keep their word: their Python runs, their commands exist, their files are there."""

from __future__ import annotations

import contextlib
import functools
import io
import re
from pathlib import Path

import pytest

from terrella.cli import main

ROOT = Path(__file__).parents[1]
PATHS = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
GUIDES = {path.name: path.read_text(encoding="utf-8") for path in PATHS}
LINKING = [*PATHS, ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*/*.md"))]
SNIPPETS = [
    pytest.param(name, snippet, id=f"{name}-{number}")
    for name, page in GUIDES.items()
    if name != "from-python.md"  # tests/test_from_python.py runs it
    for number, snippet in enumerate(re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL))
]
COMMANDS = [
    pytest.param(line.strip(), id=" ".join(line.split()[1:4]))
    for page in GUIDES.values()
    for line in re.findall(r"^    (?:\.venv/bin/)?(terrella [a-z].+)$", page, re.MULTILINE)
]


@pytest.mark.parametrize(("page", "snippet"), SNIPPETS)
def test_the_python_of_the_guides_runs(page, snippet, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path / "logs"))
    if "stable_baselines3" in snippet:
        pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is missing: pip install 'terrella[sb3]'")
    exec(compile(snippet, page, "exec"), {"__name__": "guide"})


def test_there_is_python_and_there_are_commands_to_try():
    assert len(SNIPPETS) >= 4 and len(COMMANDS) >= 15


@functools.cache
def _help(path: tuple[str, ...]) -> str:
    """What `terrella PATH --help` prints; "" where there is no such command."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(io.StringIO()):
        try:
            code = main([*path, "--help"])
        except SystemExit as stopped:
            code = stopped.code
    return shown.getvalue() if code in (0, None) else ""


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_of_the_guides_have_the_flags_that_they_name(command):
    words = re.sub(r"\s+#.*", "", command).split()[1:]
    plain = tuple(word for word in words[:2] if re.fullmatch(r"[a-z][a-z-]*", word))
    shown = _help(plain) or _help(plain[:1])
    assert shown, f"there is no `terrella {' '.join(plain)}`"
    for flag in re.findall(r"(?<!\S)--[a-z][a-z-]*", " ".join(words)):
        assert flag in shown or flag.replace("--no-", "--") in shown, f"`{command}`: its --help knows no {flag}"


def test_the_make_targets_of_the_readme_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"^    make (\w+)", GUIDES["README.md"], re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"README says `make {target}`, the Makefile has none"


@pytest.mark.parametrize("path", LINKING, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_the_files_that_a_page_links_are_there(path):
    for link in re.findall(r"\]\(([\w./-]+)(?:#[\w-]*)?\)", path.read_text(encoding="utf-8")):
        assert (path.parent / link).exists(), f"{path.name} links {link}"


@pytest.mark.parametrize("name", GUIDES)
def test_a_guide_is_short_enough_to_be_read(name):
    assert len(GUIDES[name].split()) <= 1_200 + 800 * (name == "README.md"), "tables and experiments belong in docs/lab"
