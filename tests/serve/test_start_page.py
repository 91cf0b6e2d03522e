"""The start page: cards, thumbnails, one page at a time, and the way back."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
import threading
import urllib.error
import urllib.request
import weakref
from pathlib import Path
from types import SimpleNamespace

import pytest
from PIL import Image

from terrella.core.errors import ServeError, TerrellaError
from terrella.exchange.browse import Browse
from terrella.serve import ServeConfig
from terrella.serve.http_server import make_server, open_port
from terrella.serve.server import Sessions, build_app
from terrella.serve.start_page import StartCard, StartPage
from terrella.serve.viewer import build_viewer
from terrella.workflows.opening import ControlsConfig
from terrella.workflows.play import PlayConfig, first_seed
from terrella.workflows.progress import silent
from terrella.workflows.splat_places import unedited_scene
from terrella.workflows.start import FolderShelf

from . import rig
from .panorama import Panorama
from .test_page import open_page, until  # noqa: F401  (a fixture)


class Drawer:
    """Two panoramas of different names, and words."""

    def __init__(self):
        self.built: list[str] = []
        folder = tempfile.mkdtemp()
        weakref.finalize(self, shutil.rmtree, folder)
        self.marks = Path(folder) / "marks.json"

    def cards(self):
        return [
            StartCard(name, name.title(), "bundled", "A view.")
            for name in ("hills", "broken", "a recording", *self.built)
        ]

    def thumbnail(self, name):
        data = io.BytesIO()
        Image.new("RGB", (8, 6), (9, 99, 9)).save(data, "JPEG")
        return data.getvalue()

    def open(self, name):
        if name == "broken":
            raise TerrellaError("broken cannot be opened; choose another.")
        if name == "a recording":
            return lambda host, token: build_viewer(Browse(rig.lively(1), self.marks), host, token)
        sessions = Sessions([Panorama()], ServeConfig())
        return lambda host, token: build_app(sessions, host, token)

    def build(self, words):
        self.built.append(words)
        return words

    def build_plan(self, plan):
        self.plan = plan
        return "hills"

    def lift(self, name, picture):
        if not picture:
            raise TerrellaError(f"{name} is empty; give another picture.")
        self.picture = name, picture
        return "hills"

    def progress(self):
        return "light from lamps"


@contextlib.contextmanager
def started(token=None, shelf=None):
    listener, ready, address = open_port("127.0.0.1", 0), threading.Event(), []

    def begun(url: str) -> None:
        address.append(url)
        ready.set()

    server = make_server(
        StartPage(shelf or Drawer(), token=token), listener, "127.0.0.1", token, begun, websockets=True
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    assert ready.wait(20)
    yield address[0]
    server.should_exit = True
    thread.join(20)
    listener.close()


@contextlib.contextmanager
def client(token=None):
    """get(path) and post(path, content) -> status, text, headers."""
    with started(token) as url:
        base = url.partition("/?")[0].rstrip("/")

        def ask(path: str, content: str | None = None):
            try:
                answer = urllib.request.urlopen(base + path, None if content is None else content.encode(), timeout=20)
            except urllib.error.HTTPError as error:
                answer = error
            return SimpleNamespace(status=answer.status, headers=answer.headers, text=answer.read().decode("latin-1"))

        yield SimpleNamespace(get=ask, post=ask)


def test_what_is_opened_has_an_address_of_its_own_and_the_start_page_stays():
    with client() as http:
        assert "Step inside" in http.get("/").text and [
            card["name"] for card in json.loads(http.get("/start/cards").text)
        ] == [
            "hills",
            "broken",
            "a recording",
        ]
        assert http.get("/start/thumbnail?name=hills").headers["content-type"] == "image/jpeg"
        assert http.get("/start/thumbnail?name=../secret").status == 404
        assert http.post("/start/open", json.dumps({"name": "hills"})).status == 200
        assert 'id="timeline"' in http.get("/?open").text and http.get("/check").text == "ok"
        assert 'id="timeline"' in http.get("/?token=x&open=").text and "Step inside" in http.get("/?token=open").text
        assert "Step inside" in http.get("/").text, "who opens the address again is at the start"
        assert http.post("/start/build", json.dumps({"words": "a hall"})).status == 200


@pytest.mark.parametrize(
    "body", ["", "[]", "{}", '{"name": 4}', '{"name": ""}', '{"name": "elsewhere"}', '{"name": "broken"}', "[" * 3000]
)
def test_what_cannot_be_opened_is_refused_in_one_sentence(body):
    with client() as http:
        answer = http.post("/start/open", body)
        assert answer.status == 422 and answer.text.endswith(".") and "Step inside" in http.get("/").text


def test_pictures_and_plans_are_sent_and_faults_are_sentences():
    with client() as http:
        assert http.post("/start/picture?name=a.jpg", "pixels").status == 200
        assert http.post("/start/plan", json.dumps({"rooms": []})).status == 200
        for path, body, sentence in (
            ("/start/picture?name=a.jpg", "", "a.jpg is empty"),
            ("/start/plan", "[]", "reload it"),
            ("/start/plan", " " * (1 << 18), "bytes"),
        ):
            answer = http.post(path, body)
            assert answer.status == 422 and sentence in answer.text
        assert http.get("/start/progress").text == "light from lamps"
        kinds = json.loads(http.get("/start/kinds").text)
        assert "kitchen" in kinds["rooms"] and kinds["things"]["chair"]["size"] == [0.45, 0.45]


def test_a_plan_is_drawn_with_the_mouse_and_built_and_a_picture_dropped(browser, tmp_path):
    shelf = Drawer()
    with started("sesame", shelf) as url:
        context = browser.new_context(viewport={"width": 1000, "height": 700})
        page = context.new_page()
        page.goto(url)
        page.click("#plan")
        until(page, "!!window.plan?.plan")
        pixel = """([x, y]) => { const matrix = document.getElementById('board').getScreenCTM();
            const at = new DOMPoint(x, -y).matrixTransform(matrix); return [at.x, at.y]; }"""

        def drag(*places):
            page.mouse.move(*page.evaluate(pixel, places[0]))
            page.mouse.down()
            for place in places[1:]:
                page.mouse.move(*page.evaluate(pixel, place))
            page.mouse.up()

        page.click("#make button")
        assert page.inner_text("#help") == "Draw a room first."
        drag([0, 0], [2, 2], [4, 3])
        drag([4.1, 0.1], [6, 3])  # snaps to the first
        page.select_option("#label", "sofa")
        drag([2, 1])
        page.keyboard.press("Tab")
        page.click("#turn")
        drag([2, 1], [2.5, 1.5])
        assert page.evaluate("plan.plan.rooms.map(({ box }) => box)") == [[0, 0, 4, 3], [4, 0, 6, 3]]
        assert page.evaluate("plan.plan.things") == [{"label": "sofa", "at": [2.5, 1.5], "facing": "east"}]
        page.select_option("#kind", "kitchen")
        drag([0.5, 0.5], [0.5, 1.5])  # a room takes along what stands in it
        page.focus("#board")
        page.keyboard.press("ArrowUp")
        assert page.evaluate("[plan.plan.rooms[0].box, plan.plan.things[0].at]") == [[0, 1.25, 4, 4.25], [2.5, 2.75]]
        page.keyboard.press("Delete")
        assert page.evaluate("[plan.plan.rooms.length, plan.plan.things.length]") == [1, 0]
        for _ in range(3):
            page.click("#undo")
        assert page.evaluate("[plan.plan.rooms[0].box, plan.plan.things[0].at]") == [[0, 0, 4, 3], [2.5, 1.5]]
        for _ in range(3):
            page.click("#undo")
        assert page.evaluate("[plan.plan.rooms.length, plan.plan.things.length]") == [2, 0]
        page.reload()  # the plan is kept
        until(page, "!!window.plan?.plan && plan.plan.rooms.length === 2")
        page.fill("#style", "rustic")
        page.click("#make button")
        page.wait_for_selector("#timeline")
        assert shelf.plan["words"] == "rustic" and shelf.plan["furnish"] is True and len(shelf.plan["rooms"]) == 2
        page.goto(url)
        page.set_input_files("#picture", {"name": "a cat.png", "mimeType": "image/png", "buffer": b"pixels"})
        page.wait_for_selector("#timeline")
        assert shelf.picture == ("a cat.png", b"pixels")
        context.close()


def test_a_picture_and_a_plan_become_places_in_folders_of_their_own(tmp_path, monkeypatch):
    lifted, planned = [], []
    monkeypatch.setattr(
        "terrella.workflows.start.lift_space", lambda file, out, config, progress: lifted.append((file.name, out.name))
    )
    monkeypatch.setattr("terrella.workflows.start.build_plan", lambda plan, out, progress: planned.append(out.name))
    shelf = FolderShelf(tmp_path, PlayConfig(), ControlsConfig(), ServeConfig(), silent)
    shelf.lift("../../etc/My Cat.png", b"")
    shelf.lift("..", b"")
    shelf.build_plan({"words": "rustic, at dusk"})
    assert lifted == [("My-Cat.png", "my-cat"), ("picture", "picture")] and planned == ["rustic-at-dusk"]


def test_a_picture_that_cannot_be_lifted_is_named_as_it_was_dropped(tmp_path):
    shelf = FolderShelf(tmp_path, PlayConfig(), ControlsConfig(), ServeConfig(), silent)
    for name, sentence in (
        ("a cat.png", "a-cat.png cannot be read"),
        ("film.mp4", "space fit film.mp4 --out film-place` makes"),
    ):
        with pytest.raises(ServeError, match=sentence) as failed:
            shelf.lift(name, b"pixels")
        assert tempfile.gettempdir() not in str(failed.value) and not (tmp_path / "places").exists()


def test_a_place_of_a_plain_picture_opens_with_a_warning(tmp_path):
    shelf, file = FolderShelf(tmp_path, PlayConfig(), ControlsConfig(), ServeConfig(), silent), io.BytesIO()
    Image.new("RGB", (96, 64), "grey").save(file, "PNG")
    out = shelf.lift("grey.png", file.getvalue())
    note = unedited_scene(out).note
    assert "the picture is plain" in note and note.startswith("beside and behind what the picture shows is nothing")
    shelf.open(out)
    assert shelf.progress() == "opening the place"


def test_a_token_is_asked_for():
    with client("sesame") as http:
        assert http.get("/start/draw").status == 403 and http.post("/start/picture", "x").status == 403
        assert http.get("/start/cards").status == 403 and http.post("/start/open", "{}").status == 403
        assert http.get("/start/cards?token=sesame").status == 200


def test_a_click_opens_a_world_and_its_mark_leads_back(browser):
    with started("sesame") as url:
        context = browser.new_context(viewport={"width": 390, "height": 844})
        page = context.new_page()
        page.goto(url)
        page.click("text=Broken")
        until(page, "document.getElementById('opening').classList.contains('failed')")
        assert page.text_content("#opening") == "broken cannot be opened; choose another."
        page.click("#opening")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.click("text=Hills")
        page.wait_for_selector("#timeline")
        until(page, "!!window.terrella && terrella.painted > 2")
        assert page.text_content("#brand").strip() == "Start page"
        other = browser.new_context().new_page()  # a tab that knows nothing of this one
        other.goto(page.url)
        other.wait_for_selector("#brand[href]")
        other.goto(url)
        other.wait_for_selector(".card")
        other.context.close()
        page.press("#brand", "Enter")
        page.wait_for_selector(".card")
        page.click("text=A Recording")
        page.wait_for_selector(".episode")
        page.press(".brand", "Enter")
        page.fill("#describe", "a hall")
        page.press("#describe", "Enter")
        page.wait_for_selector("#timeline")
        until(page, "!!window.terrella && terrella.painted > 2")
        context.close()


def test_a_folder_has_its_worlds_places_and_recordings(tmp_path):
    for folder, text in (
        ("runs/maze/world/world.json", {"kind": "learned", "about": {}, "card": {"what": "of a maze"}}),
        ("places/hall/world.json", {"kind": "splat", "name": "a wide hall", "card": {}}),
        ("recordings/walk/meta/info.json", {"total_episodes": 1, "total_frames": 1200}),
        ("recordings/broken/meta/info.json", ["no"]),
        (".cache/hidden/world.json", {"kind": "splat"}),
        ("node_modules/x/world.json", {"kind": "splat"}),
    ):
        file = tmp_path / folder
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(text))
    shelf = FolderShelf(tmp_path, PlayConfig(), ControlsConfig(), ServeConfig(), silent)
    mine = {(card.title, card.section, card.text) for card in shelf.cards() if card.section not in ("bundled", "game")}
    assert mine == {
        ("runs/maze", "world", "of a maze"),
        ("a wide hall", "place", "places/hall"),
        ("recordings/walk", "recording", "1 episode, 1,200 frames"),
    }
    assert {card.name for card in shelf.cards() if card.section == "bundled"} >= {"doom-maze", "doom-corridor"}
    assert shelf.thumbnail("doom-maze")[:2] == b"\xff\xd8"


def test_the_first_view_is_on_the_card_or_chosen_among_learned_worlds_alone():
    world = Panorama()
    assert first_seed(world) == 0, "starting a simulator twelve times takes too long"
    for card, seeds in (({"seed": 7}, {7}), ({"kind": "learned"}, set(range(12)))):
        world.spec = world.spec.__class__(**{**vars(world.spec), "card": card})
        assert first_seed(world) in seeds
