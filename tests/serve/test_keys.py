"""Keys changed on the page: used at once, kept where the page says, and told where two things want one key."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from terrella.core import Spec
from terrella.core.errors import ProtocolError, TerrellaError
from terrella.core.keys import default_keys, with_changes, with_controls
from terrella.core.spec import neutral_action
from terrella.serve.keys import KeyBook, Rebound, actions_of
from terrella.serve.protocol import parse_message

from .panorama import Panorama
from .robot import Robot
from .test_page import open_page, until  # noqa: F401  (a fixture)
from .test_server import Client


def spec_of(space: spaces.Space, *names: str, **options) -> Spec:
    keys = {"keys": default_keys(space, names)} | options
    return Spec("toy", space, {}, (), 0.1, action_names=names, **keys)


def listed(spec: Spec) -> dict[str, tuple[float, ...]]:
    return {action.name + action.sign: action.value for action in actions_of(spec)}


def test_everything_that_can_be_done_is_listed():
    assert listed(spec_of(spaces.Discrete(2, start=1))) == {"action 0": (1,), "action 1": (2,)}
    assert listed(Panorama().spec)["turn left"] == (0, 0, 0, 0, 1, 0)
    several = listed(spec_of(spaces.MultiDiscrete([3, 2]), "turn", "fire"))
    assert several == {"turn: 1": (1, 0), "turn: 2": (2, 0), "fire": (0, 1)}
    assert listed(spec_of(spaces.MultiDiscrete([3]), idle=(1.0,), keys={})) == {
        "choice 1: 0": (0,),
        "choice 1: 2": (2,),
    }
    car = spec_of(spaces.Box(np.float32([-1, 0]), np.float32([1, 1])), "steer", "gas", keys={"KeyW": [0.5, 1.0]})
    assert listed(car) == {"steer −": (-1, 0), "steer +": (1, 0), "gas": (0, 1), "steer 0.5, gas 1": (0.5, 1)}


def test_a_page_changes_keys_and_names_and_what_rests_goes_on_resting():
    book = KeyBook(spec_of(spaces.Discrete(3), "left", "noop", "jump"))
    assert book.described()["resting"] == 1 and book.described()["keys"]["Space"] == 2
    spec = book.changed(Rebound({"KeyX": 2, "KeyA+KeyX": 0}, {1: "stand", 2: "flap"}))
    assert spec.keys == {"KeyX": [2.0], "KeyA+KeyX": [0.0]} and spec.action_names == ("left", "stand", "flap")
    assert neutral_action(spec) == 1, "whatever it is called now"
    book.keep(spec)
    assert book.spec.action_names[2] == "jump", "each page has its own keys"
    with pytest.raises(TerrellaError, match="own"):
        book.changed(Rebound({}, {1: "jump"}))
    with pytest.raises(TerrellaError, match="3 actions"):
        book.changed(Rebound({"KeyX": 3}))


def test_what_has_a_place_is_kept_there_and_can_be_undone():
    kept: list[Spec] = []
    book = KeyBook(spec_of(spaces.MultiBinary(2)), kept.append, "in a folder")
    book.keep(book.changed(Rebound({"KeyX": 1}, {0: "jump"})))
    assert kept[-1] is book.spec and book.spec.action_names == ("jump", "button 2")
    told = book.described()
    assert [action["name"] for action in told["actions"]] == ["jump", "button 2"] and told["keys"] == {"KeyX": 1}
    book.keep(book.changed(Rebound(told["first_keys"])))
    assert (
        book.spec == kept[-1] and book.spec.action_names == () and book.spec.keys == default_keys(spaces.MultiBinary(2))
    )


@pytest.mark.parametrize(
    "body",
    [{}, {"keys": {"../x": 0}}, {"keys": {"KeyA": -1}}, {"keys": {"KeyA": "0"}}, {"keys": {}, "names": [[0, " "]]},
     {"keys": {}, "names": [[0, "x" * 41]]}, {"keys": {}, "names": ["x"]}, {"keys": {f"K{n}": 0 for n in range(300)}}],
)  # fmt: skip
def test_junk_is_refused(body):
    with pytest.raises(ProtocolError):
        parse_message(json.dumps({"type": "keys", **body}))


def test_keys_over_the_wire_move_the_world_at_once(serve_world):
    kept: list[Spec] = []
    with Client(serve_world([Panorama()], keep=kept.append).socket_url) as client:
        hello = client.event("hello")["worlds"][0]
        assert hello["keys"]["ArrowLeft"] == 4 and hello["actions"][4]["name"] == "turn left" and not hello["kept_in"]
        client.say("keys", keys={"KeyJ": 0}, names=[])
        client.say("controls", id=1, held=["KeyJ"], axes=[], t=5.0)
        while client.frame().episode_return < 3:  # walking forward is the reward
            pass
        client.say("keys", keys={"KeyJ": 99}, names=[])
        assert "6 actions" in client.event("error")["text"]
    assert kept[-1].keys == {"KeyJ": [1, 0, 0, 0, 0, 0]}


def test_one_page_has_not_the_keys_of_another_unless_they_are_the_worlds(serve_world):
    for kept_in in ("", "in the world's folder"):
        server = serve_world([Panorama()], kept_in=kept_in, keep=lambda spec: None)
        with Client(server.socket_url) as one:
            one.event("hello")
            one.say("keys", keys={"KeyJ": 0}, names=[[0, "run"]])
            one.say("controls", id=1, held=["KeyJ"], axes=[], t=5.0)
            while one.frame().episode_return < 1:
                pass
            with Client(server.socket_url) as other:
                world = other.event("hello")["worlds"][0]
                assert (world["keys"] == {"KeyJ": 0}) == (world["actions"][0]["name"] == "run") == bool(kept_in)
                assert world["first_keys"]["KeyW"] == 0


def test_keys_of_the_world_reach_the_pages_that_are_open(serve_world):
    server = serve_world([Panorama()], kept_in="in the world's folder", keep=lambda spec: None)
    with Client(server.socket_url) as one, Client(server.socket_url) as other:
        one.event("hello")
        other.event("hello")
        one.say("keys", keys={"KeyJ": 0}, names=[[0, "run"]])
        told = other.event("keys")
        assert told["keys"] == {"KeyJ": 0} and told["actions"][0]["name"] == "run"
        other.say("controls", id=1, held=["KeyJ"], axes=[], t=5.0)
        while other.frame().episode_return < 3:
            pass
        assert not any(event["type"] == "keys" for event in one.events)


def test_what_is_kept_is_what_was_changed():
    own = spec_of(spaces.Discrete(3), "left", "noop", "jump", keys={"KeyA": [0.0], "Space": [2.0]})
    begun = with_controls(own, ["s=left", "space=2"], idle="left")
    book = KeyBook(begun)
    assert with_changes(own, begun, begun) == own
    kept = with_changes(own, begun, book.changed(Rebound({"KeyS": 0, "KeyX": 2})))
    assert kept == replace(own, keys={"KeyA": [0.0], "KeyX": [2.0]})
    kept = with_changes(own, begun, book.changed(Rebound({"KeyS": 0, "Space": 2}, {1: "stand"})))
    assert kept.action_names == ("left", "stand", "jump") and kept.keys == own.keys
    assert kept.idle == (1.0,), "what rests in the world, and not what was said for once"
    bare = spec_of(spaces.Discrete(3))
    begun = with_controls(bare, action_names=["a", "b", "c"])
    kept = with_changes(bare, begun, KeyBook(begun).changed(Rebound({}, {2: "jump"})))
    assert kept.action_names == ("action 0", "action 1", "jump")


# -- in a browser -----------------------------------------------------------------------------------------------------------


def row(page, name: str):
    return page.locator("#keys-panel li", has=page.locator(f"input[aria-label='Name of {name}']"))


def caps(page, name: str) -> list[str]:
    return row(page, name).locator(".cap:not(.add)").all_text_contents()


def said(page) -> str:
    return page.locator("#keys-said").text_content()


def test_a_key_is_changed_by_a_click_and_a_press_and_used_at_once(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world().url)
    page.click("#keys-open")
    assert caps(page, "forward") == ["W", "↑"] and "this browser" in page.locator("#keys-kept").text_content()
    row(page, "forward").locator(".cap").first.click()
    page.keyboard.press("KeyI")
    assert caps(page, "forward") == ["I", "↑"] and said(page) == ""
    assert "KeyI" in page.evaluate("terrella.keys") and "KeyW" not in page.evaluate("terrella.keys")
    page.keyboard.down("KeyI")
    until(page, "terrella.held.join() === 'KeyI' && Number(document.getElementById('score').textContent) > 1")
    page.keyboard.up("KeyI")
    page.keyboard.press("KeyW")
    assert page.evaluate("terrella.held") == [] and page.evaluate("terrella.state") == "playing"


def test_what_was_set_is_there_again_after_a_reload_until_it_is_reset(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world().url)
    page.click("#keys kbd >> nth=0")  # a cap below the picture asks for its key
    page.keyboard.press("KeyI")
    row(page, "turn left").locator("input").fill("port")
    page.keyboard.press("Enter")
    page.reload()
    until(page, "!!window.terrella && terrella.painted > 2")
    assert "port" in page.locator("#keys").text_content()
    page.click("#keys-open")
    assert caps(page, "forward") == ["I", "↑"] and caps(page, "port") == ["←"]
    page.keyboard.down("KeyI")
    until(page, "Number(document.getElementById('score').textContent) > 1")
    page.keyboard.up("KeyI")
    page.click("#keys-reset")
    assert caps(page, "forward") == ["W", "↑"] and caps(page, "turn left") == ["←"]
    assert page.evaluate("localStorage.length") == 0 and not page.locator("#keys-reset").is_visible()


@pytest.mark.parametrize("kept_in", ["", "in the world's folder"])
def test_a_key_that_is_changed_on_one_page_is_changed_on_the_other(serve_world, open_page, kept_in):  # noqa: F811
    url = serve_world(kept_in=kept_in, keep=lambda spec: None).url
    page = open_page(url)
    other = page.context.new_page()
    other.goto(url)
    until(other, "!!window.terrella && terrella.painted > 2")
    page.bring_to_front()
    page.click("#keys-open")
    row(page, "forward").locator(".cap").first.click()
    page.keyboard.press("KeyI")
    row(page, "turn left").locator("input").fill("port")
    page.keyboard.press("Enter")
    until(other, "terrella.keys.includes('KeyI') && !terrella.keys.includes('KeyW')")
    until(other, "document.getElementById('keys').textContent.includes('port')")
    page.click("#keys-reset")
    until(other, "terrella.keys.includes('KeyW') && !document.getElementById('keys').textContent.includes('port')")
    other.close()


def test_conflicts_are_told_in_a_sentence(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world().url)
    page.click("#keys-open")
    row(page, "forward").locator(".cap").first.click()
    page.keyboard.press("KeyA")
    assert said(page) == "A was “left” and is now “forward”; “left” has no key any more."
    assert caps(page, "left") == [] and row(page, "left").locator(".add").text_content() == "set a key"
    row(page, "left").locator(".add").click()
    page.keyboard.press("KeyP")
    assert said(page).startswith("P also pauses on this page")
    page.keyboard.press("KeyP")
    time.sleep(0.1)
    assert page.evaluate("terrella.state") == "playing", "the world's keys come first"
    row(page, "left").locator(".cap").first.click()
    page.keyboard.press("ControlLeft")
    assert "browser" in said(page)
    page.keyboard.press("Backspace")
    assert caps(page, "left") == [] and "has no key" in said(page)
    row(page, "left").locator(".add").click()
    page.keyboard.press("Escape")
    assert caps(page, "left") == [] and page.locator("#keys-panel").is_visible()
    page.keyboard.press("Escape")
    assert not page.locator("#keys-panel").is_visible() and page.evaluate("terrella.state") == "playing"


class Chooser(Panorama):
    """A panorama with choices: combinations of keys have actions of their own."""

    def __init__(self):
        super().__init__()
        names = ("NOOP", "UP", "RIGHT", "UPRIGHT")
        action, mode = spaces.Discrete(4), "choice"
        keys = default_keys(action, names)
        self.spec = replace(self.spec, action=action, action_names=names, action_mode=mode, keys=keys)

    def imagine(self, state, action, rng):
        turned = (action == 3).long()
        return self._ticketed(
            state.replace(column=state["column"] + turned, walked=(action == 3).float(), age=state["age"] + 1)
        )


def test_combinations_follow_their_keys_and_can_be_pressed_together(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Chooser()]).url)
    page.click("#keys-open")
    assert caps(page, "upright") == ["↑ + →"] and "no key held" in row(page, "noop").text_content()
    row(page, "up").locator(".cap", has_text="↑").click()
    page.keyboard.press("KeyI")
    assert caps(page, "upright") == ["I + →"]
    page.keyboard.down("KeyI")
    page.keyboard.down("ArrowRight")
    until(page, "Number(document.getElementById('score').textContent) > 2")
    page.keyboard.up("KeyI")
    page.keyboard.up("ArrowRight")
    row(page, "upright").locator(".cap").first.click()
    page.keyboard.down("KeyJ")
    page.keyboard.down("KeyK")
    page.keyboard.up("KeyK")
    page.keyboard.up("KeyJ")
    assert caps(page, "upright") == ["J + K"]


def test_sticks_do_the_same_whatever_the_keys(serve_world, open_page):  # noqa: F811
    phone = {"viewport": {"width": 900, "height": 844}, "has_touch": True, "is_mobile": True}
    page = open_page(serve_world().url, **phone)
    page.click("#keys-open")
    row(page, "forward").locator(".cap").first.click()
    page.keyboard.press("KeyI")
    page.click("#keys-close")
    box = page.locator("#stick").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 60)
    until(page, "terrella.held.length === 1 && ['KeyI', 'ArrowUp'].includes(terrella.held[0])")
    page.mouse.up()


def test_the_worlds_folder_is_named_and_axes_have_their_ends(serve_world, open_page):  # noqa: F811
    kept: list[Spec] = []
    robot = Robot(keys={"KeyW": [2.0, 0.0, 0.0]})
    page = open_page(serve_world([robot], keep=kept.append, kept_in="in the world's folder, runs/robot").url)
    page.click("#keys-open")
    assert "runs/robot" in page.locator("#keys-kept").text_content()
    names = page.locator("#keys-panel li input").evaluate_all("all => all.map((one) => one.ariaLabel)")
    assert names == [f"Name of {name}" for name in ("forward −", "forward +", "turn −", "turn +", "gripper")]
    row(page, "turn −").locator("input").fill("yaw")
    page.keyboard.press("Enter")
    assert row(page, "yaw +").count() == 1 and page.locator("#axes b").nth(1).text_content() == "yaw"
    page.locator("#keys-panel li").nth(4).locator(".add").click()
    page.keyboard.press("Space")
    page.keyboard.down("Space")
    until(page, "document.querySelectorAll('#axes output')[2].textContent === '1'")
    page.keyboard.up("Space")
    end = time.monotonic() + 30.0  # the page answers its own keys before the server has stored them
    while not (kept and "Space" in kept[-1].keys) and time.monotonic() < end:
        time.sleep(0.02)
    assert kept[-1].keys["Space"] == [0.0, 0.0, 1.0] and kept[-1].action_names == ("forward", "yaw", "gripper")
    assert page.evaluate("localStorage.length") == 0
