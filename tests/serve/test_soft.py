"""A page in a browser without a graphics card: workers draw, as WebGL does, and everything can be done."""

from __future__ import annotations

import numpy as np

from terrella.cli import main
from terrella.worlds.splat_folder import save_splat

from .test_place_page import opened, until, world  # noqa: F401  (fixtures)

WITHOUT = """const real = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind) { return kind === 'webgl2' ? null : real.call(this, kind); };"""
FAILING = """const Real = Worker;
Worker = class extends Real { postMessage(data, ...more) { super.postMessage(data.width === 33 ? { id: 1 } : data, ...more); } };"""
SOME = "terrella.pixels().then(({ data }) => data.filter((_, k) => (k >> 2) % 17 === 0))"  # every 17th pixel: all take long to send
CHANGES = (
    "drawing.tint = 1",
    "drawing.stops = -1",
    "editor.choose({ object: 1 })",
    "editor.preview({ turn: 0.4, move: [0.2, 0, 0.1] })",
)


def test_workers_draw_as_webgl_does(tmp_path, opened):  # noqa: F811
    save_splat(world(1500), tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    url = (tmp_path / "place.html").as_uri()
    pages, before = [opened(url), opened(url + "#webgl")], None
    for page in pages:
        page.evaluate("terrella.stand([1.5, 2.0, 1.4], 0.7, -0.1)")
    for change in ("", *CHANGES):
        shown = []
        for page in pages:
            page.evaluate(f"terrella.{change}" if change else "0")
            until(page, "terrella.idle")
            shown.append(np.array(page.evaluate(SOME), float).reshape(-1, 4)[:, :3])
        assert np.square(shown[0] - shown[1]).mean() < 12, change  # above 37 dB
        assert before is None or np.abs(shown[0] - before).mean() > 0.05, change
        before = shown[0]


def test_without_webgl_one_walks_and_edits(tmp_path, browser):
    save_splat(world(1500), tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page = browser.new_page(viewport={"width": 320, "height": 240})
    page.add_init_script(WITHOUT)
    page.goto((tmp_path / "place.html").as_uri())
    until(page, "!!window.terrella && terrella.idle")
    begin = page.evaluate("[terrella.eye.place[0], terrella.drawing.shown]")
    page.keyboard.down("KeyW")
    until(page, f"Math.abs(terrella.eye.place[0] - {begin[0]}) > 0.2 && terrella.drawing.shown > {begin[1]} + 2")
    page.keyboard.up("KeyW")
    until(page, "terrella.idle && document.getElementById('view').width === 320")  # at rest it is sharp
    page.keyboard.press("KeyE")
    page.evaluate("terrella.editor.choose({ all: true }); terrella.editor.act({ do: 'delete' })")
    until(page, "terrella.idle && terrella.story.edits.length === 1")
    assert (
        page.evaluate(
            "terrella.pixels().then(({ data }) => Math.max(...data.filter((_, k) => k % 4 < 3 && k % 5 === 0)))"
        )
        < 20
    )
    page.close()


def test_without_workers_the_page_says_so(tmp_path, browser):
    save_splat(world(300), tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    for by in ("", "#webgl"):
        page = browser.new_page()
        page.add_init_script("delete window.Worker")
        page.goto((tmp_path / "place.html").as_uri() + by)
        until(page, "document.getElementById('place').dataset.state === 'failed'")
        assert page.inner_text("#banner") == "This browser runs no web workers; open the place in a newer one."
        page.close()


def test_a_worker_that_fails_is_said_and_the_next_view_is_drawn(tmp_path, browser):
    save_splat(world(300), tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page = browser.new_page(viewport={"width": 32, "height": 24})
    page.add_init_script(FAILING)
    page.goto((tmp_path / "place.html").as_uri())
    until(page, "!!window.terrella && terrella.idle")
    page.set_viewport_size({"width": 33, "height": 24})
    until(page, "document.getElementById('toast').textContent.includes('could not draw')")
    until(page, "terrella.idle")
    page.set_viewport_size({"width": 40, "height": 24})
    until(page, "terrella.idle && document.getElementById('view').width === 40")
    page.close()


def test_pictures_on_the_way_grow_coarser_again(tmp_path, opened):  # noqa: F811
    save_splat(world(300), tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page = opened((tmp_path / "place.html").as_uri())
    page.evaluate("Object.assign(terrella.drawing, { share: 1, ms: 1000 })")
    page.keyboard.down("KeyW")
    until(page, "terrella.drawing.share < 1")
    page.keyboard.up("KeyW")
