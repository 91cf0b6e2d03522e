"""The page of a place that is still being made: newer states reach it, and nobody waits for it."""

from __future__ import annotations

import json
import threading
import urllib.request
from dataclasses import replace

import pytest

from terrella.serve.live_place import live_page
from terrella.workflows.splat_places import page_scene

from .test_place_page import opened, until, world  # noqa: F401


def fetched(address: str) -> tuple[int, bytes]:
    with urllib.request.urlopen(address, timeout=60) as answer:
        return answer.status, answer.read()


@pytest.fixture
def making():
    """A page of 300 Gaussians: its address, and what shows it others."""
    address: list[str] = []
    ready = threading.Event()

    def on_ready(one: str) -> None:
        address.append(one)
        ready.set()

    with live_page("127.0.0.1", 0, on_ready) as show:
        show(lambda: page_scene(world(300)), {"step": 0, "steps": 100, "db": 12.0})
        assert ready.wait(60)
        yield address[0], show


def test_newer_states_are_told_once(making):
    address, show = making
    assert b"/now" in fetched(address)[1]
    status, content = fetched(f"{address}now?after=0")
    about = json.loads(content[4 : 4 + int.from_bytes(content[:4], "little")])
    assert status == 200 and about["count"] == 300 and about["step"] == 0
    assert fetched(f"{address}now?after={about['number']}") == (204, b"")
    assert fetched(f"{address}now?after=nonsense")[0] == 200
    made = []
    for step in range(3):
        show(
            lambda step=step: made.append(step) or page_scene(world(310 + step)),
            {"step": step, "steps": 100, "db": 13.0},
        )
    status, content = fetched(f"{address}now?after={about['number']}")
    assert json.loads(content[4 : 4 + int.from_bytes(content[:4], "little")])["count"] == 312
    assert made == [2]  # what nobody asked for is never packed


def test_the_page_shows_what_is_newest_and_outlives_the_fit(opened, making):  # noqa: F811
    address, show = making
    page = opened(address)
    assert page.evaluate("document.getElementById('edit').hidden")
    show(lambda: replace(page_scene(world(700)), name="later"), {"step": 50, "steps": 100, "db": 23.4})
    until(page, "terrella.story.scene.length === 700 && terrella.idle")
    assert page.evaluate("document.getElementById('what').textContent") == "700 Gaussians · step 50 of 100 · 23.4 dB"
