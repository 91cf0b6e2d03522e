"""Things that words put into a place: built, merged by edits, moved by handles, taken back; and the page's orbit."""

from __future__ import annotations

import json
import math
import urllib.error
import urllib.request

import pytest
import torch

from terrella.cli import main
from terrella.core.errors import ContractError, ServeError, TerrellaError
from terrella.library import load
from terrella.serve.place_page import build_place
from terrella.serve.thing_page import Spot, read_spot
from terrella.space.layout.one_thing import build_thing, parse_things
from terrella.space.layout.placing import FurnitureRequest
from terrella.workflows.editable_place import editable_place
from terrella.workflows.put_things import put_things
from terrella.worlds.splat import SplatWorld
from terrella.worlds.splat_folder import load_source, read_edits, save_splat, write_edits

from .test_place_page import opened, serving, until, walled_by, world  # noqa: F401  (fixtures)


def test_words_name_things_to_put():
    things, unknown, style = parse_things("Put two small red chairs right here, and a wobbly japanese lamp on the left")
    assert [(one.label, one.count, one.look) for one in things] == [("chair", 2, "red"), ("lamp", 1, "")]
    assert unknown == ("wobbly", "left") and style == "japanese"
    for words in ("", "a zeppelin", "a red door", "nothing"):
        with pytest.raises(ContractError, match="names? a thing|is a thing to put"):
            parse_things(words)
    with pytest.raises(ContractError, match="at most 12"):
        parse_things("thirteen chairs")
    with pytest.raises(ContractError, match="12 m is the most"):
        build_thing(FurnitureRequest("table", 1, "", (20.0, 1.0, 1.0)))


@pytest.mark.parametrize(
    ("label", "stands"), [("chair", "any"), ("picture", "hung"), ("pendant", "ceiling"), ("rug", "middle")]
)
def test_a_thing_stands_around_the_origin(label, stands):
    thing = build_thing(FurnitureRequest(label, 1, "", (1.0, 1.0, 1.0)))
    across, deep, high = thing.size
    low, high_end = thing.gaussians.means.amin(0), thing.gaussians.means.amax(0)
    assert thing.stands == stands and len(thing.gaussians) > 100
    assert float(low[2]) > -0.02 and abs(float(high_end[2]) - high) < 0.05
    assert (low[:2] > -torch.tensor([across, deep]) / 2 - 0.1).all() and (
        high_end[:2] < torch.tensor([across, deep]) / 2 + 0.1
    ).all()
    assert thing.solids.shape[1] == 6 and float(thing.solids[:, 2].min()) > -1e-3


def test_things_stand_in_a_row_on_walls_and_under_ceilings(tmp_path):
    save_splat(world(300), tmp_path / "w")
    row = put_things(tmp_path / "w", "two chairs", Spot((1.0, 2.0, 0.4), 0.4, degrees=90)).edits
    (ax, ay, az), (bx, by, bz) = (edit["by"] for edit in row)
    assert ax == bx == 1 and az == bz == 0.4 and math.isclose(by - ay, 0.45 + 0.12) and math.isclose(ay + by, 4)
    assert row[0]["sha256"] == row[1]["sha256"] and len(list((tmp_path / "w" / "things").iterdir())) == 1
    [sofa] = put_things(tmp_path / "w", "a sofa", Spot((4.0, 1.0, 1.2), 0.0, wall=True, degrees=270)).edits
    assert sofa["by"] == [round(4 - 0.95 / 2, 3), 1, 0]  # its back touches the wall
    [picture] = put_things(tmp_path / "w", "a picture", Spot((4.0, 1.0, 1.6), 0.0, wall=True, degrees=270)).edits
    assert picture["by"][2] == pytest.approx(1.6 - 0.35)
    [picture] = put_things(tmp_path / "w", "a picture", Spot((4.0, 1.0, 1.6), 2.0, wall=True, degrees=270)).edits
    assert picture["by"][2] == pytest.approx(1.6 - 0.35)  # what is above the pointer is no floor
    [lamp] = put_things(tmp_path / "w", "a pendant", Spot((2.0, 1.0, 0.0), 0.0, ceiling=2.6)).edits
    assert lamp["by"][2] == pytest.approx(1.8)
    with pytest.raises(TerrellaError, match="400 or fewer"):
        put_things(tmp_path / "w", "chair " * 100, Spot((0, 0, 0), 0))
    assert not read_edits(tmp_path / "w")


@pytest.mark.parametrize(
    "bad", [{}, {"at": [0, 0]}, {"at": [0, 0, "x"]}, {"at": [0, 0, math.nan]}, {"at": [1e9, 0, 0]}, {"at": 3}]
)
def test_a_spot_is_made_of_finite_numbers(bad):
    with pytest.raises(ServeError, match="a spot has"):
        read_spot({"floor": 0, "degrees": 0, **bad})


def test_a_thing_is_put_from_the_command_line_and_taken_back(tmp_path, capsys):
    save_splat(world(300), tmp_path / "w")
    folder = str(tmp_path / "w")
    assert main(["space", "edit", folder, "--put", "a red wobbly chair", "--move", "1", "2", "0", "--turn", "90"]) == 0
    assert "wobbly" in "".join(capsys.readouterr())
    after = load(folder)
    assert isinstance(after, SplatWorld) and after.object_names[-1] == "red chair"
    assert (after.gaussians.means[300:, :2].mean(0) - torch.tensor([1.0, 2.0])).abs().max() < 0.3
    assert main(["space", "edit", folder, "--undo"]) == 0 and not read_edits(tmp_path / "w")
    assert main(["space", "edit", folder, "--put", "a zeppelin"]) == 2


def test_a_thing_is_put_on_the_page_moved_by_handles_and_saved(tmp_path, opened, serving):  # noqa: F811
    save_splat(world(1500), tmp_path / "w")
    page = opened(serving(build_place(editable_place(str(tmp_path / "w")))), size=(900, 700))
    page.evaluate("terrella.stand([2, 2, 1.6], 0, -0.6)")
    until(page, "terrella.idle")
    page.keyboard.press("KeyN")
    page.mouse.click(600, 420)
    spot = page.evaluate("terrella.editor.put.spot")
    assert spot["degrees"] % 90 == 0 and abs(spot["floor"]) < 0.3
    page.keyboard.type("a wobbly stool")
    page.keyboard.press("Enter")
    until(page, "terrella.story.edits.length === 1")
    assert page.evaluate("document.getElementById('toast').textContent") == "Not understood: wobbly."
    number = page.evaluate("terrella.editor.chosen.object")
    assert page.inner_text("#count").endswith("stool") and page.is_visible("#gizmo")
    keys = ["ArrowUp", "ArrowUp", "PageUp", "BracketLeft"]  # in a row: one move, and one turn
    page.evaluate("keys => keys.forEach((code) => dispatchEvent(new KeyboardEvent('keydown', { code })))", keys)
    until(page, "terrella.story.edits.length === 3")
    turned, moved = page.evaluate("terrella.story.edits.slice(1)")
    assert turned == {"select": {"object": number}, "do": "turn", "degrees": 15}
    assert moved["by"] == pytest.approx([0.2, 0, 0.1])
    page.evaluate(
        """() => { const ring = document.querySelector('[data-part=ring]');
        const path = ring.getAttribute('d').slice(1).split('L').map((pair) => pair.split(' ')), [from, to] = [path[0], path[18]];
        const pointer = (at) => ({ clientX: at[0], clientY: at[1], pointerId: 1 });
        Object.assign(ring, { setPointerCapture() {}, hasPointerCapture: () => true });
        ring.dispatchEvent(new PointerEvent('pointerdown', pointer(from)));
        ring.dispatchEvent(new PointerEvent('pointermove', pointer(to)));
        ring.dispatchEvent(new PointerEvent('pointerup', pointer(to))); }"""
    )
    assert page.evaluate("terrella.story.edits.at(-1).degrees") == 90
    page.evaluate("document.getElementById('save').click()")
    until(page, "!terrella.story.unsaved")
    edits, after = read_edits(tmp_path / "w"), load(tmp_path / "w")
    assert [edit["do"] for edit in edits] == ["merge", "turn", "move", "turn"] and isinstance(after, SplatWorld)
    assert len(after.gaussians) == page.evaluate("terrella.story.scene.length") > 1500
    for _ in range(4):
        page.keyboard.press("Control+z")
    assert page.evaluate("terrella.story.scene.length") == 1500
    page.reload()
    until(page, "!!window.terrella && terrella.story.edits.length === 4")


def test_what_keys_moved_stays_moved_whatever_comes_next(tmp_path, opened, serving):  # noqa: F811
    save_splat(world(300), tmp_path / "w")
    page = opened(serving(build_place(editable_place(str(tmp_path / "w")))), size=(300, 200))
    page.keyboard.press("KeyE")
    edits = "(() => { const { editor, story } = terrella; %s; return story.edits.map((edit) => edit.do); })()"
    key = "dispatchEvent(new KeyboardEvent('keydown', { code: '%s' })); "
    page.evaluate("terrella.editor.choose({ object: 1 })")
    assert page.evaluate(edits % (key % "ArrowUp" + "editor.choose({ object: 2 })")) == ["move"]
    assert page.evaluate(edits % (key % "BracketLeft" + "document.getElementById('undo').click()")) == ["move"]
    assert page.evaluate(edits % (key % "PageUp" + "editor.toggle()")) == ["move", "move"]


def test_what_a_page_posts_reaches_its_own_place_alone(tmp_path, serving):  # noqa: F811
    for name in "ab":
        save_splat(world(300), tmp_path / name)
    a, b = (editable_place(str(tmp_path / name)) for name in "ab")
    url, [edit] = serving(build_place(b)), put_things(tmp_path / "b", "a stool", Spot((1.0, 1.0, 0.0), 0.0)).edits

    def posted(path: str, **wish) -> tuple[int, str]:
        request = urllib.request.Request(url + path, json.dumps(wish).encode(), {"Host": "localhost"})
        try:
            return 200, urllib.request.urlopen(request).read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    thing = {"words": "a stool", "spot": {"at": [1, 1, 0], "floor": 0, "degrees": 0}}
    lines = {"saved": "", "lines": json.dumps(edit)}  # put before the server was started anew
    for path, wish in (("edits", lines), ("things", thing), ("files", {"kind": "spz"})):
        status, said = posted(path, **wish, key=a.key)  # of a tab whose place was open before
        assert status == 422 and "has opened another place since" in said
    assert not read_edits(tmp_path / "b") and posted("edits", **lines, key=b.key) == (200, "")
    assert read_edits(tmp_path / "b") == [edit]


def test_words_that_name_nothing_and_spots_that_are_none_are_refused(tmp_path, opened, serving):  # noqa: F811
    save_splat(world(300), tmp_path / "w")
    page = opened(serving(build_place(editable_place(str(tmp_path / "w")))))
    post = """body => fetch('/things', { method: 'POST', body })
        .then((answer) => answer.text().then((text) => [answer.status, text]))"""
    spot = {"at": [1, 1, 0], "floor": 0, "degrees": 0}
    for body, sentence in (
        ({"words": "a zeppelin", "spot": spot}, "is a thing to put"),
        ({"words": "a chair", "spot": {"at": [1]}}, "finite numbers"),
        ({"words": "a chair"}, "words and a spot"),
        ({"words": "x" * 5000, "spot": spot}, "in 400 or fewer"),
    ):
        status, text = page.evaluate(post, json.dumps(body))
        assert status == 422 and sentence in text
    assert not (tmp_path / "w" / "things").exists()


def test_what_is_put_on_the_page_stands_clear_of_walls_and_within_them(tmp_path, opened, serving):  # noqa: F811
    walls = torch.tensor([[-0.2, -0.2, 0, 0, 4.2, 2.5], [-0.2, -0.2, 0, 4.2, 0, 2.5], [-0.2, -0.2, -0.2, 4.2, 4.2, 0]])
    for name, made in (("boxes", walled_by(world(1500), walls)), ("cells", world(6000))):
        save_splat(made, tmp_path / name)
        page = opened(serving(build_place(editable_place(str(tmp_path / name)))), size=(900, 500))
        page.keyboard.press("KeyN")
        at = [0.1, 0.1, 0.0] if name == "boxes" else [0.15, 2.0, 0.0]
        spot = {"at": at, "floor": 0, "wall": False, "degrees": 90, "ceiling": None}
        page.evaluate("spot => { terrella.editor.put.spot = spot; }", spot)
        page.fill("#put-words", "a crate")
        page.press("#put-words", "Enter")
        until(page, "terrella.story.edits.length === 1")
        x, y, z = page.evaluate("terrella.story.edits[0].by")
        page.keyboard.press("KeyN")
        page.evaluate("spot => { terrella.editor.put.spot = spot; }", spot | {"wall": True, "at": [0.0, 2.0, 1.5]})
        page.fill("#put-words", "a picture")
        page.press("#put-words", "Enter")
        until(page, "terrella.story.edits.length === 2")
        assert not page.inner_text("#toast") and page.evaluate("terrella.story.edits[1].by[1]") == 2
        half = 0.5 * load_source(tmp_path / name / page.evaluate("terrella.story.edits[0].place")).card["size"][0]
        assert half - 0.1 < x < 0.95 and z == 0 and (y == 2 if name == "cells" else half - 0.1 < y < 0.95)


def drag(page) -> None:
    """Drags from beside the middle of the page (900 x 500) to the right."""
    page.mouse.move(600, 250)
    page.mouse.down()
    for x in (620, 650, 690):
        page.mouse.move(x, 252)
    page.mouse.up()


def test_who_looks_around_with_the_object_tool_selects_nothing(tmp_path, opened, serving):  # noqa: F811
    save_splat(world(1500), tmp_path / "w")
    page = opened(serving(build_place(editable_place(str(tmp_path / "w")))), size=(900, 500))
    page.keyboard.press("KeyE")
    heading = page.evaluate("terrella.eye.heading")
    drag(page)
    assert page.evaluate("terrella.eye.heading") != heading
    chosen = "!!terrella.editor.chosen || !!document.getElementById('toast').textContent"
    assert not page.evaluate(chosen)
    page.mouse.click(600, 250)
    assert page.evaluate(chosen)
    middle = """(() => { const { left, width, top, height } = document.getElementById('hint').getBoundingClientRect();
        return document.elementFromPoint(left + width / 2, top + height / 2).id; })()"""
    assert page.evaluate(middle) == "view"  # the hint takes no press, seen or not
    page.evaluate("terrella.editor.choose({ object: 1 }); terrella.editor.act({ do: 'delete' })")
    (tmp_path / "empty.jsonl").write_text("\n")
    page.set_input_files("#open", str(tmp_path / "empty.jsonl"))
    until(page, "document.getElementById('toast').textContent.includes('no edits in empty.jsonl')")
    assert page.evaluate("terrella.story.edits.length") == 1


def test_the_view_turns_around_what_is_selected(tmp_path, opened, serving):  # noqa: F811
    save_splat(world(1500), tmp_path / "w")
    page = opened(serving(build_place(editable_place(str(tmp_path / "w")))), size=(900, 500))
    page.keyboard.press("KeyE")
    page.evaluate("terrella.editor.choose({ object: 1 })")
    page.keyboard.press("KeyO")
    far = "Math.hypot(...terrella.eye.place.map((part, a) => part - terrella.orbit.target[a]))"
    before, heading = page.evaluate(far), page.evaluate("terrella.eye.heading")
    page.evaluate("terrella.orbit.turn(0.5, 0.1)")
    assert page.evaluate(far) == pytest.approx(before) and page.evaluate("terrella.eye.heading") == pytest.approx(
        heading + 0.5
    )
    page.evaluate("document.getElementById('view').dispatchEvent(new WheelEvent('wheel', { deltaY: -300 }))")
    assert page.evaluate(far) < before
    page.evaluate("terrella.editor.choose({ all: true })")
    heading = page.evaluate("terrella.eye.heading")
    drag(page)  # on what is selected: it turns the view, and moves nothing
    assert page.evaluate("terrella.story.edits.length") == 0 and page.evaluate("terrella.eye.heading") != heading
    page.keyboard.down("KeyW")
    page.keyboard.up("KeyW")
    drag(page)
    assert page.evaluate("terrella.story.edits.length") == 1
    assert not page.evaluate("terrella.orbit.on") and page.get_attribute("#orbit", "aria-pressed") == "false"


def test_a_read_only_page_puts_nothing(tmp_path, opened):  # noqa: F811
    save_splat(world(300), tmp_path / "w")
    write_edits(tmp_path / "w", [])
    assert main(["space", "export", str(tmp_path / "w"), str(tmp_path / "place.html")]) == 0
    page = opened((tmp_path / "place.html").as_uri())
    page.keyboard.press("KeyE")
    assert not page.is_visible("[data-tool=put]")
