"""Measures the page of a place without a graphics card: pictures a second in headless Chromium while one turns.

python benchmarks/page.py [--gaussians 200000] [--seconds 20] [--text "a cosy library at night"]

The page is 1280 x 720; it chooses the resolution while one moves. Printed: pictures shown a second by the clock, processor time of
the browser a picture, the rate that two cores of its own would give by that, the pixels drawn, and how busy the machine was.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

import terrella
from terrella.workflows.export_space import ExportSpaceConfig, export_space

FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")
STATE = "[terrella.drawing.shown, document.getElementById('view').width, document.getElementById('view').height]"


def processor_s(root: int) -> float:
    """Processor time in seconds of a process's descendants, ended ones too."""
    parents, times = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(folder.name)], times[int(folder.name)] = int(fields[1]), sum(map(int, fields[11:15]))
    below = {root}
    while more := {child for child, parent in parents.items() if parent in below} - below:
        below |= more
    return sum(times[one] for one in below - {root}) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=200_000)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--text", default="a cosy library at night")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        out, html = Path(folder) / "room", Path(folder) / "room.html"
        facts = terrella.generate_place(
            out, text=given.text, config=terrella.BuildSpaceConfig(gaussians=given.gaussians)
        ).facts
        export_space(str(out), html, ExportSpaceConfig())
        path = os.environ.get("TERRELLA_BROWSER", "/usr/bin/chromium")
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(html.as_uri())
        while not page.evaluate("!!window.terrella && terrella.idle"):
            time.sleep(0.5)
        page.keyboard.down("ArrowLeft")  # one turns on the spot
        page.wait_for_timeout(10_000)  # until the page has chosen its resolution
        (first, _, _), used, began = page.evaluate(STATE), processor_s(os.getpid()), time.monotonic()
        page.wait_for_timeout(1000 * given.seconds)
        (last, wide, high), used = page.evaluate(STATE), processor_s(os.getpid()) - used
        own, rate = used / (time.monotonic() - began), (last - first) / (time.monotonic() - began)
        page.keyboard.up("ArrowLeft")
        browser.close()
    print(
        f"{facts['gaussians']:,} Gaussians, {wide} x {high} pixels: {rate:.1f} pictures a second by the clock; "
        f"{1000 * own / rate:.0f} ms of processor each, so {2 * rate / own:.1f} a second of two cores; the browser had "
        f"{own:.2f} of {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    )


if __name__ == "__main__":
    main()
