"""What every test shares: one thread, repeatable hypotheses, a browser, and skips that nobody overlooks."""

from __future__ import annotations

import os
import shutil

import pytest
import torch
from hypothesis import HealthCheck, settings

torch.set_num_threads(1)
os.fsync = lambda handle: None  # processes are killed here, machines are not: nothing has to wait for the disk
settings.register_profile(
    "terrella", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("terrella")

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
QUIET = (
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-gpu",
    "--no-first-run",
)


def find_browser() -> str | None:
    """A Chromium's path: TERRELLA_BROWSER, one on PATH, or None."""
    return os.environ.get("TERRELLA_BROWSER") or next(filter(None, map(shutil.which, BROWSERS)), None)


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium as a playwright `Browser`, closed with the file: its event loop must not outlive it."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install -e '.[dev]'")
    flags = [*QUIET, "--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else list(QUIET)
    with api.sync_playwright() as playwright:
        path = find_browser() or playwright.chromium.executable_path
        if not os.path.exists(path):
            pytest.skip("no browser: install chromium, or set TERRELLA_BROWSER to a Chromium's path")
        chromium = playwright.chromium.launch(executable_path=path, args=flags)
        yield chromium
        chromium.close()


# The folders with the longest files, longest first: what comes last is short, so no worker waits long for the other.
LONG = ("tests", "learn", "physics", "serve", "worlds", "cli", "space", "sim", "measure")


def pytest_collection_modifyitems(items):
    """Files of the long folders come first, and within a file its browser tests come last."""
    browsing = {id(item) for item in items if "browser" in getattr(item, "fixturenames", ())}
    for item in items:
        if id(item) in browsing:
            item.add_marker("browser")
    files = {path: number for number, path in enumerate(dict.fromkeys(item.path for item in items))}
    rank = {path: LONG.index(path.parent.name) if path.parent.name in LONG else len(LONG) for path in files}
    items.sort(key=lambda item: (rank[item.path], files[item.path], id(item) in browsing))


def pytest_terminal_summary(terminalreporter):
    """Says what was not tested and why, where everybody looks."""
    reasons: dict[str, int] = {}
    for report in terminalreporter.stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        reasons[reason.removeprefix("Skipped: ")] = reasons.get(reason.removeprefix("Skipped: "), 0) + 1
    if reasons:
        terminalreporter.section("NOT TESTED HERE", sep="!", red=True, bold=True)
        for reason, count in sorted(reasons.items()):
            terminalreporter.line(f"{count} skipped: {reason}", red=True)
