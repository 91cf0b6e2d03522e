"""What a stranger sees and does on the page: who draws it, the keys, hits and endings, the timeline by keyboard, legible text."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import Spec, State
from terrella.serve import server
from terrella.serve.presentation import aims, drawn_by, outcome

from .panorama import Panorama
from .robot import Robot
from .test_page import open_page, until  # noqa: F401  (a fixture)

PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
SIDEWAYS = {"viewport": {"width": 844, "height": 390}, "has_touch": True, "is_mobile": True}


class Range(Panorama):
    """A shooting range: every shot hits, and each of them costs 40 health. It has as many numbers as a page shows."""

    def __init__(self, **options):
        super().__init__(**options)
        space, keys = spaces.MultiBinary(7), {code: [*value, 0.0] for code, value in self.spec.keys.items()}
        event = spaces.Box(0, 1, (), np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
        more = {"health": spaces.Box(0, 100, (), np.float32), "hit": event, "fallen": event}
        names = (*self.spec.action_names, "ATTACK")
        keys["Space"] = [0.0] * 6 + [1.0]
        card = {"kind": "learned", "what": "a range"}
        channels = {**self.spec.channels, **more}
        self.spec = replace(
            self.spec, name="range", action=space, keys=keys, action_names=names, channels=channels, card=card
        )

    def start(self, batch, rng):
        return super().start(batch, rng).replace(shots=torch.zeros(batch), hit=torch.zeros(batch))

    def imagine(self, state, action, rng):
        shot = torch.as_tensor(action)[:, 6].float()
        spec, self.spec = self.spec, replace(self.spec, action=spaces.MultiBinary(6))
        after = super().imagine(state, torch.as_tensor(action)[:, :6], rng)
        self.spec = spec
        return after.replace(shots=state["shots"] + shot, hit=shot)

    def _channel(self, state: State, name: str):
        if name == "health":
            return 100 - 40 * state["shots"]
        if name in ("hit", "fallen"):
            return state["hit"] > 0
        return 100 - 40 * state["shots"] <= 0 if name == "done" else super()._channel(state, name)


def spec(kind: object = None, names: tuple[str, ...] = ("a", "b"), posed: bool = True) -> Spec:
    channels = {"rgb": spaces.Box(0, 255, (4, 4, 3), np.uint8)}
    channels |= {"pose": spaces.Box(-9, 9, (7,), np.float32)} if posed else {}
    return Spec("some", spaces.MultiBinary(len(names)), channels, (), 0.1, action_names=names, card={"kind": kind})


def test_only_a_network_is_called_a_network():
    assert drawn_by(spec("learned")) == "A neural network draws every frame. No game engine is running."
    assert "simulator" in drawn_by(spec("simulator")) and "Gaussians" in drawn_by(spec("splat"))
    assert drawn_by(spec()) == "" and drawn_by(spec(["learned"])) == ""


def test_who_shoots_through_a_camera_aims():
    assert aims(spec(names=("left", "SHOOT"))) and not aims(spec(names=("left", "right")))
    assert not aims(spec(names=("left", "FIRE"), posed=False)), "a flat game has no middle to aim with"


@pytest.mark.parametrize(
    ("names", "values", "reward", "before", "steps", "ending"),
    [
        (["health"], [0.0], -100.0, 3.0, 50, "died"),
        (["lives", "fuel"], [0.0, 3.0], 0.0, 0.0, 9, "died"),
        (["fuel"], [0.0], 1.0, -0.02, 200, "won"),
        ([], [], -100.0, -40.0, 80, "lost"),
        ([], [], 1.0, 99.0, 100, "over"),
        ([], [], -1.0, -150.0, 151, "over"),
        ([], [], 0.0, 0.0, 1, "over"),
    ],
)
def test_an_ending_has_a_name(names, values, reward, before, steps, ending):
    assert outcome(names, values, reward, before, steps)["outcome"] == ending


def test_what_a_person_does_comes_first_and_hits_and_death_are_shown(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Range()]).url)
    assert page.text_content("#what") == "A neural network draws every frame. No game engine is running."
    parts = page.locator("#hint span").all_text_contents()
    assert parts == ["Spaceattack", "WASDmove", "←→turn"]
    assert page.locator("#keys b").first.text_content() == "Space" and page.locator("figure .aim").count() == 1
    page.keyboard.down("Space")
    until(page, "document.querySelector('.aim.struck') && Number(document.getElementById('vital-hit').textContent) > 0")
    until(page, "document.getElementById('app').classList.contains('ended')")
    page.keyboard.up("Space")
    until(page, "document.getElementById('vital-health').textContent === '0'")  # of -20
    titles = [page.get_attribute(f".vital:has(#vital-{name})", "title") for name in ("health", "hit", "fallen")]
    assert "At 0" in titles[0] and "hit something" in titles[1] and "have fallen" in titles[2]
    assert page.text_content("#ending-text") == "You died" and "hits" in page.text_content("#ending-more")
    until(page, "!document.getElementById('app').classList.contains('ended')")
    until(page, "document.getElementById('vital-hit').textContent === '0'")


@pytest.mark.parametrize("size", [(1280, 800), (1440, 900), (1920, 1080)])
def test_no_key_is_cut_off(serve_world, open_page, size):  # noqa: F811
    page = open_page(serve_world([Range()]).url, viewport={"width": size[0], "height": size[1]})
    deck, buttons = (page.locator(name).bounding_box() for name in ("#deck", ".buttons"))
    for cap in page.locator("#keys kbd").all():
        box = cap.bounding_box()
        assert box["x"] >= deck["x"] and box["y"] + box["height"] <= size[1]
        assert box["x"] + box["width"] <= buttons["x"] or box["y"] + box["height"] <= buttons["y"], cap.text_content()
        assert cap.evaluate("node => [...node.children].every((part) => part.scrollWidth <= part.clientWidth + 1)")


def test_enter_goes_on_after_a_rewind_by_mouse(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Panorama(dt_s=1 / 40)]).url)
    until(page, "terrella.step > 60")
    page.click("#rewind", delay=300)
    until(page, "terrella.state === 'rewound'")
    page.keyboard.press("Enter")
    until(page, "terrella.state === 'playing'")


def test_the_timeline_is_a_slider_for_the_keyboard_too(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Panorama(dt_s=1 / 40)]).url)
    until(page, "terrella.step > 90")
    page.focus("#timeline")
    page.keyboard.press("PageDown")
    until(page, "terrella.state === 'rewound' && terrella.newest - terrella.step > 30")
    until(page, "document.getElementById('timeline').ariaValueText.includes('seconds ago')")
    back = page.evaluate("terrella.newest - terrella.step")
    assert 38 <= back <= 60
    page.keyboard.press("ArrowRight")
    until(page, f"terrella.newest - terrella.step === {back - 4}")
    page.keyboard.press("Home")
    until(page, "terrella.step === terrella.oldest")
    assert page.evaluate("terrella.held") == [], "the arrows were the slider's"


LEGIBLE = """() => {
  const linear = (part) => { const c = part / 255; return c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; };
  const light = (colour) => { const [r, g, b] = colour.match(/[\\d.]+/g).map(linear);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const ground = light(getComputedStyle(document.body).backgroundColor), bad = [];
  for (const node of document.querySelectorAll('#app *')) {
    const text = [...node.childNodes].filter((child) => child.nodeType === 3).map((child) => child.textContent).join('').trim();
    if (!text || !node.checkVisibility()) continue;
    const { color, fontSize, backgroundColor: under } = getComputedStyle(node);
    const [low, high] = [light(color), under.startsWith('rgb(') ? light(under) : ground].sort((a, b) => a - b);
    const contrast = (high + 0.05) / (low + 0.05);
    if (parseFloat(fontSize) < 12 || (contrast < 4.5 && high < 0.7)) bad.push([text, fontSize, contrast.toFixed(1)]);
  }
  return bad;
}"""


@pytest.mark.parametrize("screen", [{}, PHONE, SIDEWAYS], ids=["wide", "phone", "sideways"])
def test_all_text_can_be_read(serve_world, open_page, screen):  # noqa: F811
    page = open_page(serve_world([Robot()]).url, **screen)
    assert page.evaluate(LEGIBLE) == []
    page.evaluate("() => document.getElementById('about').click()")
    assert page.evaluate(LEGIBLE) == []
    assert page.locator("meta[name=viewport]").get_attribute("content").find("user-scalable") == -1


@pytest.mark.parametrize("screen", [PHONE, SIDEWAYS], ids=["phone", "sideways"])
def test_nothing_lies_on_anything_on_a_phone(serve_world, open_page, screen):  # noqa: F811
    page = open_page(serve_world([Range()]).url, **screen)
    width, height = screen["viewport"]["width"], screen["viewport"]["height"]
    parts = "header button, header h1, .stats dd, .buttons .icon, .pad, #extra button"
    parts += ", #screens canvas" if screen is SIDEWAYS else ""
    boxes = page.evaluate(
        """parts => [...document.querySelectorAll(parts)].filter((node) => node.checkVisibility())
          .map((node) => [node.id || node.textContent, node.getBoundingClientRect().toJSON()])""",
        parts,
    )
    assert {"about", "pause", "stick"} <= {name for name, _ in boxes}
    for at, (name, one) in enumerate(boxes):
        assert one["left"] >= -1 and one["right"] <= width + 1 and one["bottom"] <= height + 1, name
        for other, two in boxes[at + 1 :]:
            apart = one["right"] <= two["left"] + 1 or two["right"] <= one["left"] + 1
            assert apart or one["bottom"] <= two["top"] + 1 or two["bottom"] <= one["top"] + 1, (name, other)


def test_labels_of_buttons_keep_apart_on_a_phone(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Range()]).url, **PHONE)
    page.evaluate(
        "() => ['drive', 'futures-open', 'map-open'].forEach((id) => document.getElementById(id).hidden = false)"
    )
    labels = page.evaluate(
        """() => [...document.querySelectorAll('.buttons .icon')].filter((node) => node.checkVisibility())
          .map((node) => node.querySelector('span').getBoundingClientRect().toJSON())"""
    )
    assert len(labels) == 8 and labels[-1]["right"] <= 390
    assert all(two["left"] - one["right"] > 5 for one, two in zip(labels, labels[1:]))


class ManyJoints(Robot):
    """A robot with eight motors of 150 N m."""

    def __init__(self):
        super().__init__("torque")
        names = tuple(f"{joint}_{leg}" for leg in "1234" for joint in ("hip", "ankle"))
        self.spec = replace(
            self.spec, action=spaces.Box(-1, 1, (8,)), action_names=names, action_units=("150 N m",) * 8, keys={}
        )

    def imagine(self, state, action, rng):
        return state


def test_eight_sliders_are_seen_on_a_phone_in_their_own_units(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([ManyJoints()]).url, **PHONE)
    room = page.locator("#axes").bounding_box()
    for label in page.locator("#axes label").all():
        box = label.bounding_box()
        assert box["y"] >= room["y"] and box["y"] + box["height"] <= room["y"] + room["height"] + 1
    assert page.locator("#axes b").first.text_content() == "hip 1"
    assert page.locator("#axes output").first.text_content() == "0 N m"
    assert page.locator("#axes i").first.text_content() == "−150150"


def test_a_toast_never_covers_the_buttons(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Panorama(forkable=False)]).url)
    page.keyboard.press("Backspace")
    until(page, "document.getElementById('toast').classList.contains('show')")
    page.wait_for_timeout(300)
    toast, deck = page.locator("#toast").bounding_box(), page.locator("#deck").bounding_box()
    assert toast["y"] + toast["height"] < deck["y"]


def test_a_page_that_has_lost_its_server_shows_the_command_that_helps(serve_world, open_page, monkeypatch):  # noqa: F811
    monkeypatch.setattr(server, "starting_command", lambda: "terrella play doom-maze")
    served = serve_world()
    page = open_page(served.url)
    served.server.should_exit = True
    until(page, "terrella.state === 'away'")
    assert page.text_content("#banner-command") == "terrella play doom-maze" and page.is_visible("#banner-command")
