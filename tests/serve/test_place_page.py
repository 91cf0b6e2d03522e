"""The page of a place in a real browser: it draws, walks, edits and remembers as Python does, from a disk and from a server."""

from __future__ import annotations

import gzip
import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from terrella.cli import main
from terrella.library import load
from terrella.serve.http_server import make_server, open_port
from terrella.serve.place_page import PAGE, EditablePlace, PlacePage, build_place, bundle_script, spread_over
from terrella.space.camera import planar_pose
from terrella.space.edits import apply_edits
from terrella.space.occupancy import Occupancy, Walker
from terrella.space.raster import rasterise
from terrella.workflows.splat_places import compared_scene, unedited_scene
from terrella.worlds.splat import SolidBoxes, SplatConfig, SplatWorld
from terrella.worlds.splat_folder import checked_edits, merge_edit, read_edits, save_splat, write_edits

from ..space.test_edits import POST, standing
from ..space.test_fitting import LENS, SIZE, room
from .test_page import until as within

EDITS = [
    {"select": {"sphere": [1.0, 2.0, 0.2, 0.7]}, "do": "move", "by": [0.5, 0.25, 0.1]},
    {"select": {"box": [3.0, 0.0, 0.0, 5.0, 4.0, 3.0]}, "do": "turn", "degrees": 20},
    {"select": {"brush": [0.0, 2.0, 1.0, 0.5, 0.0, 3.0, 1.0, 0.6]}, "do": "recolour", "colour": [1, 0, 0.5]},
    {"select": {"object": 2}, "do": "duplicate", "by": [0, 1, 0]},
    {"select": {"object": 3}, "do": "scale", "factor": 1.5},
    {"select": {"plane": [0, 0, 1, 2.2]}, "do": "delete"},
]
COLUMNS = """() => { const { scene } = terrella.story, listed = (name) => scene[name].slice();  // typed: quick to send
  const names = ['means', 'scales', 'colours', 'seen', 'objects', 'opacities'];
  return Object.fromEntries(names.map((name) => [name, listed(name)])); }"""

PATIENCE_S = 240  # drawn in software, perhaps on a busy machine
MOVED = """([p, w]) => { const { solid, walker } = terrella, { body } = walker.world;
  return p.map((at, k) => [...solid.moved(at, w[k], body), solid.floor(at, body)]); }"""


def until(page, expression: str) -> None:
    within(page, expression, PATIENCE_S)


def world(count: int) -> SplatWorld:
    two = torch.full((1,), 2.0)
    seen, objects = torch.ones(count, dtype=torch.uint8), torch.zeros(count, dtype=torch.int32)
    seen[::5], objects[100:140], objects[200:240] = 0, 1, 2
    starts = planar_pose(two, two, torch.full((1,), 1.6), torch.tensor([0.3]))
    card = {"objects": ["chair", "table"]}
    full = room(count=count)
    full = replace(full, scales=full.scales * min(1, (6000 / count) ** 0.5))  # as dense as the small one
    return SplatWorld("a <room>", full, seen, starts, SplatConfig(LENS, SIZE), card, objects)


def walled_by(full: SplatWorld, boxes: torch.Tensor) -> SplatWorld:
    """A world with known walls."""
    return SplatWorld("walls", full.gaussians, full.provenance, full.starts, full.config, solids=SolidBoxes.of(boxes))


@pytest.fixture
def opened(browser):
    """opened(address) -> a page that shows its place; fails at the end if a script threw or a policy was broken."""
    contexts, faults = [], []

    def open_page(url: str, size=(320, 240)):
        contexts.append(browser.new_context(viewport={"width": size[0], "height": size[1]}))
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda message: faults.append(message.text) if "Content Security" in message.text else None)
        page.on(
            "request",
            lambda asked: None if asked.url.startswith(("blob:", url.partition("#")[0])) else faults.append(asked.url),
        )
        page.goto(url)
        until(page, "!!window.terrella && terrella.idle")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not faults, faults


def exported(tmp_path, count: int):
    save_splat(world(count), tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    return (tmp_path / "place.html").as_uri()


def rows(means) -> np.ndarray:
    """Places in an order that does not depend on theirs."""
    means = np.asarray(means, np.float32).reshape(-1, 3)
    return means[np.lexsort(means.T)]


def test_modules_become_one_script():
    script = bundle_script(PAGE / "app.js")
    assert "\nimport " not in script and "\nexport " not in script
    assert script.index("const m_scene") < script.index("const m_edits") < script.index("const m_editor")
    assert set(script.split()) >= {"m_" + file.stem for file in PAGE.glob("*.js")} - {"m_app"}


def test_the_page_says_only_what_it_should(tmp_path):
    save_splat(world(300), tmp_path / "w")
    page = PlacePage(unedited_scene(str(tmp_path / "w")))
    text = page.html([{"select": {"all": True}, "do": "delete", "note": "</script><script>"}]).decode()
    assert "unsafe" not in page.policy and "http" not in page.policy
    assert text.count("</script>") == 6 and "<title>a &lt;room&gt;" in text and "{{" not in text


@pytest.mark.parametrize("by", ["", "#webgl"], ids=["workers", "webgl"])
def test_it_draws_what_the_rasteriser_draws(tmp_path, opened, browser, by):
    page = opened(exported(tmp_path, 3000) + by)
    assert page.evaluate("!!terrella.drawing.soft") == (not by)  # a test browser has no graphics card
    page.evaluate("terrella.stand([1.5, 2.0, 1.4], 0.7, 0)")
    until(page, "terrella.idle")
    shown, lens = page.evaluate("terrella.pixels()"), page.evaluate("terrella.lens()")
    mine = np.array(shown["data"], np.uint8).reshape(shown["height"], shown["width"], 4)[::-1, :, :3] / 255
    pose = planar_pose(*(torch.tensor([value]) for value in (1.5, 2.0, 1.4, 0.7)))
    true = rasterise(world(3000).gaussians, pose, (0.5 / lens["wide"], 0.5 / lens["tall"], 0.5, 0.5), mine.shape[:2])
    error = float(((torch.tensor(mine).permute(2, 0, 1) - true.rgb[0].clamp(0, 1)) ** 2).mean())
    assert -10 * math.log10(error) > 33


def test_edits_do_on_the_page_what_they_do_in_python(tmp_path, opened):
    place = world(3000)
    place.objects[300:320], place.gaussians.opacities[300:320] = -3, 0.0  # hidden beneath what becomes object 3
    save_splat(place, tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page = opened((tmp_path / "place.html").as_uri())
    page.evaluate("edits => { terrella.story.replay(edits); }", EDITS)
    there, here = page.evaluate(COLUMNS), apply_edits(place.gaussians, EDITS, place.objects)
    assert len(there["seen"]) == len(here.gaussians) < 3040
    assert np.abs(rows(there["means"]) - rows(here.gaussians.means)).max() < 1e-6
    seen = torch.where(here.origin < 0, 0, place.provenance[here.origin])
    for name, mine in (("seen", seen), ("objects", here.objects)):
        assert sorted(there[name]) == sorted(mine.tolist())
    assert min(there["opacities"]) > 0 and not (here.objects < 0).any() and here.gaussians.opacities.min() > 0
    for name, mine, off in (("scales", here.gaussians.scales, 0.035), ("colours", here.gaussians.colours, 0.01)):
        theirs = np.asarray(there[name]).reshape(-1, 3)
        order, other = (
            np.lexsort(np.asarray(there["means"]).reshape(-1, 3).T),
            np.lexsort(here.gaussians.means.numpy().T),
        )
        assert (
            np.abs(theirs[order].clip(0, 1) - mine.numpy()[other]) / (1 if name == "colours" else mine.numpy()[other])
        ).max() < off
    page.evaluate("() => { for (let k = 0; k < 6; k += 1) terrella.story.undo(); }")
    assert np.array_equal(rows(page.evaluate(COLUMNS)["means"]), rows(place.gaussians.means))


def test_surfaces_go_on_on_the_page_as_in_python(tmp_path, opened):
    place = standing()
    starts = world(1).starts
    save_splat(
        SplatWorld("post", place, torch.ones(len(place), dtype=torch.uint8), starts, SplatConfig(LENS, SIZE)),
        tmp_path / "w",
    )
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page, edits = opened((tmp_path / "place.html").as_uri()), [{**POST, "do": "move", "by": [0.0, 0.0, 3.0]}]
    page.evaluate("edits => { terrella.story.replay(edits); }", edits)
    there, here = page.evaluate(COLUMNS), apply_edits(place, edits)
    assert len(here.gaussians) > len(place) + 30 and sum(there["seen"]) == int((here.origin >= 0).sum())
    assert np.abs(rows(there["means"]) - rows(here.gaussians.means)).max() < 1e-6
    theirs, mine = (np.asarray(one, np.float32).reshape(-1, 3) for one in (there["colours"], here.gaussians.colours))
    orders = (
        np.lexsort(np.asarray(one, np.float32).reshape(-1, 3).T) for one in (there["means"], here.gaussians.means)
    )
    assert (np.abs(theirs[next(orders)].clip(0, 1) - mine[next(orders)]).max(1) < 0.01).mean() > 0.999


def merged(tmp_path, count: int, edits=()):
    """A world's folder that another one was merged into, after which it was edited."""
    save_splat(world(count), tmp_path / "w")
    save_splat(world(600), tmp_path / "other")
    lines = [merge_edit(tmp_path / "w", tmp_path / "other", (6, 0.3, 0.1), 33), *edits]
    write_edits(tmp_path / "w", lines)
    return tmp_path / "w"


def test_what_was_merged_is_on_the_page(tmp_path, opened):
    folder = merged(tmp_path, 3000, [{"select": {"object": 4}, "do": "duplicate", "by": [0, 0, 1]}])
    assert main(["space", "export", str(folder), str(tmp_path / "place.html")]) == 0
    page, after = opened((tmp_path / "place.html").as_uri()), load(folder)
    assert isinstance(after, SplatWorld) and len(after.gaussians) == 3640
    for _ in range(2):
        there = page.evaluate(COLUMNS)
        assert np.abs(rows(there["means"]) - rows(after.gaussians.means)).max() < 1e-6
        assert sorted(there["objects"]) == sorted(after.objects.tolist())
        assert sum(there["seen"]) == int(after.provenance.sum())
        for many in (3600, 3000):
            page.evaluate("document.getElementById('undo').click()")
            assert page.evaluate("terrella.story.scene.length") == many
        page.evaluate("document.getElementById('redo').click(); document.getElementById('redo').click()")
    page.evaluate("terrella.editor.choose({ object: 4 })")
    assert page.evaluate("document.getElementById('count').textContent") == "40 selected: table"
    points = after.gaussians.means[3000:3200] + torch.tensor([0.0, 0.0, 1.0])
    wish = 0.6 * torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) - 0.3
    theirs = torch.tensor(page.evaluate(MOVED, [points.tolist(), wish.tolist()]))
    body = after.config.body
    mine = torch.cat([after.collider.walk(points, wish, body), after.collider.floor(points, body)[:, None]], 1)
    assert ((theirs - mine).abs().amax(1) < 0.02).float().mean() > 0.97


def test_known_walls_of_merged_places_are_met_as_in_python(tmp_path, opened):
    boxes, full = (
        torch.tensor([[-1, -1, -0.2, 5, 5, 0], [1, 1, 0, 2, 2, 0.3], [0, 3, 0, 4, 3.2, 2]]).float(),
        world(600),
    )
    for name in ("w", "other"):
        save_splat(walled_by(full, boxes), tmp_path / name)
    write_edits(tmp_path / "w", [merge_edit(tmp_path / "w", tmp_path / "other", (9, 1, 0.1), -90)])
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page, after = opened((tmp_path / "place.html").as_uri()), load(tmp_path / "w")
    assert isinstance(after, SplatWorld) and len(after.solids) == 6
    assert np.allclose(page.evaluate("terrella.solid.boxes"), after.solids)
    page.evaluate("terrella.editor.change(() => terrella.story.undo())")
    assert len(page.evaluate("terrella.solid.boxes")) == 3


def test_bodies_move_as_they_do_in_python(tmp_path, opened):
    page, place, body = opened(exported(tmp_path, 6000)), world(6000), Walker()
    rng = torch.Generator().manual_seed(1)
    points = torch.tensor([-0.5, -0.5, 1.2]) + torch.tensor([5.0, 5.0, 1.5]) * torch.rand(300, 3, generator=rng)
    wish = 0.6 * torch.rand(300, 3, generator=rng) - 0.3
    for solid in (place.occupancy, Occupancy.of(apply_edits(place.gaussians, EDITS[:1]).gaussians)):
        theirs = torch.tensor(page.evaluate(MOVED, [points.tolist(), wish.tolist()]))
        mine = torch.cat([solid.walk(points, wish, body), solid.floor(points, body)[:, None]], 1)
        assert ((theirs - mine).abs().amax(1) < 0.02).float().mean() > 0.97
        page.evaluate("edits => { terrella.editor.change(() => terrella.story.replay(edits)); }", EDITS[:1])


def test_a_closed_collider_stays_closed_after_an_edit(tmp_path, opened):
    open_place = world(6000)
    config = replace(open_place.config, collider="indoor")
    closed = SplatWorld("closed", open_place.gaussians, open_place.provenance, open_place.starts, config)
    save_splat(closed, tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page, place = opened((tmp_path / "place.html").as_uri()), closed.occupancy
    page.evaluate("edits => { terrella.editor.change(() => terrella.story.replay(edits)); }", EDITS[:1])
    theirs = torch.tensor(page.evaluate("terrella.solid.solid")).view(place.solid.shape).bool()
    edited = Occupancy.of(apply_edits(place_of := open_place.gaussians, EDITS[:1]).gaussians)
    assert edited.solid.shape == place.solid.shape == theirs.shape
    changed = edited.solid != Occupancy.of(place_of).solid
    assert changed.any() and (theirs == torch.where(changed, edited.solid, place.solid)).float().mean() > 0.999
    assert (theirs & ~edited.solid).sum() > 1000  # what no flood reaches is still solid


def test_known_walls_are_met_as_in_python(tmp_path, opened):
    boxes = torch.tensor(
        [[-1, -1, -0.2, 5, 5, 0], [4, -1, 0, 4.2, 5, 3], [1, 1, 0, 2, 2, 0.3], [0, 3, 0, 4, 3.2, 2]]
    ).float()
    body, walled = Walker(), walled_by(world(600), boxes)
    save_splat(walled, tmp_path / "w")
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page, rng = opened((tmp_path / "place.html").as_uri()), torch.Generator().manual_seed(2)
    points = torch.tensor([0.0, 0.0, 1.6]) + torch.tensor([4.0, 4.0, 0.6]) * torch.rand(300, 3, generator=rng)
    wish = torch.rand(300, 3, generator=rng) - 0.5
    theirs = torch.tensor(page.evaluate(MOVED, [points.tolist(), wish.tolist()]))
    mine = torch.cat([walled.collider.walk(points, wish, body), walled.collider.floor(points, body)[:, None]], 1)
    assert ((theirs - mine).abs().amax(1) < 0.01).float().mean() > 0.98


def test_what_is_shown_first_lies_on_all_surfaces():
    place = world(6000).gaussians
    first = spread_over(place, 700)
    off = torch.cdist(place.means, place.means[first]).amin(1)
    chance = torch.cdist(
        place.means, place.means[torch.randperm(6000, generator=torch.Generator().manual_seed(0))[:700]]
    )
    assert int(first.sum()) == 700 and off.max() < 0.8 * chance.amin(1).max()


def test_a_large_place_shows_before_all_of_it_is_there(tmp_path, opened, browser, monkeypatch):
    monkeypatch.setattr("terrella.serve.place_page.WHOLE", 2000)
    monkeypatch.setattr("terrella.serve.place_page.FIRST", 500)
    save_splat(world(4000), tmp_path / "w")
    content = PlacePage(unedited_scene(str(tmp_path / "w"))).html(EDITS[:1])
    early, _, late = content.partition(b'<script type="text/plain" id="rest">')
    (tmp_path / "early.html").write_bytes(early)
    (tmp_path / "whole.html").write_bytes(early + b'<script type="text/plain" id="rest">' + late)
    page = browser.new_page(viewport={"width": 320, "height": 240})
    page.goto((tmp_path / "early.html").as_uri())
    until(page, "!!window.terrella && terrella.painted > 0")
    assert page.evaluate("[terrella.story.scene.length, terrella.drawing.stands, terrella.idle]") == [500, 8, False]
    page.close()
    page = opened((tmp_path / "whole.html").as_uri())
    after = apply_edits(world(4000).gaussians, EDITS[:1])
    assert np.array_equal(rows(page.evaluate(COLUMNS)["means"]), rows(after.gaussians.means))
    assert page.evaluate("!terrella.story.unsaved && !document.getElementById('edit').hidden")
    assert main(["space", "export", str(merged(tmp_path, 4000)), str(tmp_path / "both.html")]) == 0
    page = opened((tmp_path / "both.html").as_uri())
    assert page.evaluate("terrella.story.scene.length") == 4600


@pytest.mark.slow
def test_fewer_gaussians_leave_no_surface_open(tmp_path, opened):
    words = "a small room with a pillar and a window"
    assert main(["space", "build", words, "--out", str(tmp_path / "w"), "--gaussians", "6000"]) == 0
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page = opened((tmp_path / "place.html").as_uri() + "#webgl")
    whole = page.evaluate("terrella.drawing.count")
    ask = """most => new Promise((done) => { terrella.sorter.onOrder = done; terrella.sorter.ask({ ...terrella.sight(), most }); })
        .then(({ order, coarse, all }) => { terrella.drawing.order(order, coarse); return [order.length, coarse, all]; })"""
    for most in (whole // 3, whole // 10):
        drawn, coarse, seen = page.evaluate(ask, most)
        assert seen == whole and 0.4 * most < drawn <= most and 0.002 < coarse < 0.2
        shown = np.array(page.evaluate("terrella.pixels()")["data"], np.uint8).reshape(-1, 4)
        assert (shown[:, 3] < 150).mean() < 1e-3
    assert page.evaluate(ask, 1e9) == [whole, 0, whole]
    page.evaluate("terrella.sorter.ask = () => {}; terrella.walker.look(1.5, 0)")  # the order for there never comes
    shown = np.array(page.evaluate("terrella.pixels()")["data"], np.uint8).reshape(-1, 4)
    assert (shown[:, 3] < 150).mean() < 0.02


@pytest.mark.slow
def test_a_place_of_200_000_is_walked_in_and_edited(tmp_path, opened):
    page = opened(exported(tmp_path, 200_000))
    assert len(gzip.compress((tmp_path / "place.html").read_bytes())) < 6_000_000
    before = page.evaluate("terrella.eye.place")
    page.keyboard.down("KeyW")
    until(page, f"Math.hypot(terrella.eye.place[0] - {before[0]}, terrella.eye.place[1] - {before[1]}) > 0.5")
    page.keyboard.up("KeyW")
    until(page, "terrella.idle")
    page.keyboard.down("KeyW")  # to the wall, and no farther
    time.sleep(2)
    page.keyboard.up("KeyW")
    until(page, "terrella.idle")
    assert page.evaluate("terrella.eye.place")[0] < 3.95 and abs(page.evaluate("terrella.eye.place")[2] - 1.6) < 0.2

    page.evaluate("terrella.stand([2, 2, 1.6], 0.3, -0.3)")
    until(page, "terrella.idle")
    page.keyboard.press("KeyE")
    page.evaluate("document.querySelector('[data-tool=sphere]').click()")
    page.mouse.move(250, 30)  # above the panel
    page.mouse.down()
    page.mouse.move(262, 30, steps=3)
    page.mouse.up()
    until(page, "!!terrella.editor.mask")
    chosen = page.evaluate("terrella.editor.mask.count")
    page.evaluate("document.querySelector('[data-do=delete]').click()")
    until(page, f"terrella.idle && terrella.story.scene.length === {200_000 - chosen}")
    page.keyboard.press("Control+z")
    until(page, "terrella.story.scene.length === 200000")
    page.keyboard.press("Control+Shift+Z")
    until(page, f"terrella.story.scene.length === {200_000 - chosen}")
    page.evaluate("terrella.editor.choose({ sphere: [2, 2, 0, 0.5] })")
    page.evaluate(
        "document.getElementById('colour').value = '#ff0000'; document.querySelector('[data-do=recolour]').click()"
    )
    with page.expect_download() as download:
        page.evaluate("document.getElementById('save').click()")
    download.value.save_as(tmp_path / "saved.jsonl")
    assert main(["space", "edit", str(tmp_path / "w"), "--replay", str(tmp_path / "saved.jsonl")]) == 0
    after, there = load(tmp_path / "w"), page.evaluate(COLUMNS)
    assert isinstance(after, SplatWorld) and len(after.gaussians) == 200_000 - chosen
    assert np.array_equal(rows(there["means"]), rows(after.gaussians.means))
    assert sum(there["seen"]) == int((after.provenance == 1).sum()) < 160_000


def test_a_place_is_compared_with_what_it_was_and_with_another(tmp_path, opened):
    page = opened(exported(tmp_path, 3000))
    page.keyboard.press("KeyB")
    assert not page.evaluate("terrella.compare.open") and "no edits to compare" in page.inner_text("#toast")
    page.evaluate("terrella.stand([1.0, 2.0, 1.6], 0.2, -0.3)")
    page.evaluate(
        "terrella.editor.change(() => terrella.story.add({ select: { all: 0 }, do: 'recolour', colour: [1, 0, 0] }))"
    )
    page.keyboard.press("KeyB")
    until(page, "terrella.idle && terrella.compare.db !== null")
    assert 3 < page.evaluate("terrella.compare.db") < 25 and page.inner_text("#other-name") == "before its edits"
    before = page.evaluate("document.getElementById('other').style.clipPath")
    page.mouse.move(160, 45)
    page.mouse.down()
    page.mouse.move(240, 45, steps=3)
    page.mouse.up()
    assert abs(page.evaluate("terrella.compare.at") - 0.75) < 0.02
    assert page.evaluate("document.getElementById('other').style.clipPath") != before
    page.keyboard.press("Control+z")
    until(page, "terrella.idle && terrella.compare.db === Infinity")
    assert page.inner_text("#compare-db") == "the same"
    page.keyboard.press("KeyB")
    assert page.evaluate("document.getElementById('compare').hidden")


@pytest.mark.parametrize(("name", "least"), [("other.ply", 40), ("other.spz", 30)])
def test_what_is_exported_after_an_edit_shows_what_was_edited(tmp_path, opened, name, least):
    save_splat(world(3000), tmp_path / "w")
    write_edits(tmp_path / "w", EDITS[:1])
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / name)]) == 0
    html = PlacePage(unedited_scene(str(tmp_path / "w")), compared_scene(str(tmp_path / name)))
    (tmp_path / "beside.html").write_bytes(html.html(read_edits(tmp_path / "w")))
    page = opened((tmp_path / "beside.html").as_uri())
    page.keyboard.press("KeyB")
    until(page, "terrella.idle && (terrella.compare.db ?? 0) > 0")
    assert page.inner_text("#other-name") == name and least < page.evaluate("Math.min(terrella.compare.db, 99)")


def test_a_server_keeps_the_edits(tmp_path, opened, serving):
    save_splat(world(1500), tmp_path / "w")
    folder = tmp_path / "w"
    save = lambda text: write_edits(folder, checked_edits(folder, text))  # noqa: E731
    url = serving(build_place(EditablePlace(unedited_scene(str(folder)), lambda: read_edits(folder), save)))
    page = opened(url)
    page.evaluate("terrella.editor.choose({ object: 1 })")
    assert page.evaluate("document.getElementById('count').textContent") == "40 selected: chair"
    page.evaluate("terrella.editor.act({ do: 'duplicate', by: [0, 0, 1] })")
    page.evaluate("document.getElementById('save').click()")
    until(page, "!terrella.story.unsaved")
    assert read_edits(folder) == [{"select": {"object": 1}, "do": "duplicate", "by": [0, 0, 1]}]
    page.reload()
    until(page, "!!window.terrella && terrella.story.scene.length === 1540")
    post = """saved => fetch('/edits', { method: 'POST', body: JSON.stringify({ saved, lines: '{"do": 1}' }) })
        .then((answer) => answer.text().then((text) => [answer.status, text]))"""
    status, said = page.evaluate(post, page.evaluate("terrella.story.saved"))
    assert status == 422 and "selects one of" in said
    status, said = page.evaluate(post, "")  # a page that was opened before those edits
    assert status == 422 and "edited elsewhere" in said
    assert len(read_edits(folder)) == 1

    write_edits(folder, [])
    merged(tmp_path, 1500)
    page.reload()
    until(page, "!!window.terrella && terrella.story.scene.length === 2100")
    for clicked, left in (("undo", 0), ("redo", 1)):
        page.evaluate(f"document.getElementById('{clicked}').click(); document.getElementById('save').click()")
        until(page, "!terrella.story.unsaved")
        assert len(read_edits(folder)) == left
    foreign = post.replace('{"do": 1}', '{"do": "merge", "place": "/", "sha256": "0", "by": [0, 0, 0], "degrees": 0}')
    status, said = page.evaluate(foreign, page.evaluate("terrella.story.saved"))
    assert status == 422 and "only the place that it was opened beside" in said


def test_a_page_whose_server_is_gone_says_so_and_what_starts_it(tmp_path, opened, serving, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/terrella", "space", "view", "my hall"])
    save_splat(world(300), tmp_path / "w")
    scene = unedited_scene(str(tmp_path / "w"))
    page = opened(serving(build_place(EditablePlace(scene, list, lambda text: None))))
    page.evaluate("terrella.editor.choose({ object: 1 })")
    page.evaluate("terrella.editor.act({ do: 'delete' })")
    serving.stop()
    page.evaluate("document.getElementById('save').click()")
    until(page, "document.getElementById('toast').textContent.includes('stopped')")
    said = page.inner_text("#toast")
    assert "bin/terrella space view 'my hall'` starts it again" in said and "Failed to fetch" not in said
    assert page.evaluate("terrella.story.unsaved")


def test_a_place_is_merged_on_the_page_with_the_one_beside_it(tmp_path, opened, serving):
    for name, many in (("w", 1500), ("other", 600)):
        made = world(many)
        made.config = replace(made.config, collider="indoor")
        save_splat(made, tmp_path / name)
    folder, merge = tmp_path / "w", merge_edit(tmp_path / "w", tmp_path / "other")
    save = lambda text: write_edits(folder, checked_edits(folder, text))  # noqa: E731
    beside = compared_scene(str(tmp_path / "other"))
    url = serving(
        build_place(EditablePlace(unedited_scene(str(folder)), lambda: read_edits(folder), save, beside, merge))
    )
    page = opened(url)
    page.keyboard.press("KeyE")
    page.mouse.move(250, 30)  # a drag that begins with a click on an object, or on none, does nothing more
    page.mouse.down()
    page.mouse.move(262, 30, steps=3)
    page.mouse.up()
    near = page.evaluate("terrella.map.box.scale")
    page.evaluate("terrella.editor.choose({ box: [3, 0, 0, 5, 4, 3] }); terrella.editor.act({ do: 'delete' })")
    until(page, "terrella.idle && terrella.story.edits.length === 1")
    assert page.evaluate("terrella.map.box.scale") == near
    page.evaluate("document.getElementById('undo').click()")
    for label, value in (("x", "4"), ("y", "-1.5"), ("degrees", "90")):
        page.locator(f"#merging input[aria-label={label}]").fill(value)
    page.evaluate("terrella.editor.choose({ box: [-1, -1, -1, 9, 3.5, 3] }); terrella.editor.act({ do: 'delete' })")
    page.click("#merge")
    until(page, "terrella.idle && terrella.story.edits.length === 2")
    assert page.evaluate("terrella.story.scene.length") < 1500  # fewer than before, with what was merged
    assert page.evaluate("terrella.map.box.scale") < 0.8 * near
    page.evaluate("document.getElementById('undo').click(); document.getElementById('undo').click()")
    page.click("#merge")
    until(page, "terrella.story.scene.length === 2100 && terrella.idle")
    assert page.evaluate("terrella.map.box.scale") < 0.8 * near  # the map shows what was merged
    page.keyboard.press("Control+z")
    until(page, "terrella.story.scene.length === 1500 && terrella.idle")
    assert page.evaluate("terrella.map.box.scale") == near
    page.keyboard.press("Control+Shift+Z")
    page.evaluate("document.getElementById('save').click()")
    until(page, "!terrella.story.unsaved")
    assert read_edits(folder) == [{**merge, "by": [4, -1.5, 0], "degrees": 90}]
    there, after = page.evaluate(COLUMNS), load(folder)
    assert isinstance(after, SplatWorld) and np.allclose(rows(there["means"]), rows(after.gaussians.means), atol=1e-5)
    assert main(["space", "export", str(folder), str(tmp_path / "both.html")]) == 0
    page.reload()
    until(page, "!!window.terrella && terrella.story.scene.length === 2100")
    for shown in (page, opened((tmp_path / "both.html").as_uri())):  # what stops walkers is closed as in Python
        until(shown, f"terrella.solid.solid.reduce((sum, one) => sum + one, 0) === {int(after.occupancy.solid.sum())}")
        assert shown.evaluate("Array.from(terrella.solid.size)") == list(after.occupancy.solid.shape)
    alone = opened(serving(build_place(EditablePlace(unedited_scene(str(folder)), list, save))))
    assert not alone.is_visible("#merging")


@pytest.fixture
def serving():
    """serving(application) -> its address; stopped at the end of the test."""
    import threading

    stops = []

    def start(app) -> str:
        listener, ready, address = open_port("127.0.0.1", 0), threading.Event(), []

        def opened(url: str) -> None:
            address.append(url)
            ready.set()

        server = make_server(app, listener, "127.0.0.1", None, opened, False)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        assert ready.wait(20)
        stops.append((server, thread, listener))
        return address[0]

    def stop() -> None:
        for server, thread, listener in stops:
            server.should_exit = True
            thread.join(20)
            listener.close()
        stops.clear()

    start.stop = stop
    yield start
    stop()
