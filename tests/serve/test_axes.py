"""Axes and cameras: what a stick, a slider or the mouse asks for reaches the world in its units; every camera can be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from terrella.core import Spec, check_world
from terrella.core.policy import Random, Reactive
from terrella.data import Layout, Recorder
from terrella.exchange.browse import browse
from terrella.serve.actions import MAX_AXES, action_of, axes_of
from terrella.serve.protocol import Show
from terrella.serve.timeline import Timeline

from .robot import HIGH, LOW, NAMES, UNITS, Robot
from .test_page import PAD, open_page, until  # noqa: F401  (a fixture)
from .test_server import Client


def test_the_robot_keeps_the_contract():
    check_world(Robot())


def spec_of(space, **options):
    return Spec(name="w", action=space, channels={}, observes=(), dt_s=1.0, **options)


def test_the_page_is_told_names_units_and_limits():
    axes = axes_of(Robot().spec)
    assert [axis["name"] for axis in axes] == list(NAMES) and axes[0]["unit"] == "m/s"
    assert [(axis["low"], axis["high"]) for axis in axes] == list(zip(LOW.tolist(), HIGH.tolist()))
    assert axes_of(spec_of(spaces.MultiBinary(4))) == [] and axes_of(spec_of(spaces.Discrete(4))) == []


def test_an_axis_without_limits_goes_as_far_as_its_keys():
    space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    reach = [(axis["low"], axis["high"]) for axis in axes_of(spec_of(space, keys={"KeyD": [3.0, 0.0]}))]
    assert reach == [(-3.0, 3.0), (-1.0, 1.0)]


def test_neutral_lies_within_the_limits_and_many_axes_are_cut():
    space = spaces.Box(2.0, 5.0, (MAX_AXES + 9,), np.float32)
    assert len(axes_of(spec_of(space))) == MAX_AXES and axes_of(spec_of(space))[0]["neutral"] == 2.0
    assert action_of(spec_of(space), (), [3.0]).tolist() == [[3.0] + [2.0] * (MAX_AXES + 8)]


@pytest.mark.parametrize(
    "axes, action",
    [([0.5, -1.5, 1.0], [0.5, -1.5, 1.0]), ([], [0, 0, 0]), ([9.0, -9.0], [2.0, -2.0, 0]), ([0.1] * 8, [0.1] * 3)],
)
def test_values_are_in_the_worlds_units_and_stay_within_its_limits(axes, action):
    world = Robot()
    found = action_of(world.spec, (), axes)
    assert np.allclose(found.numpy(), [action])
    world.spec.check_action(found, 1)


def test_a_held_key_overrides_its_axis_alone():
    spec = Robot(keys={"KeyW": [2.0, 0.0, 0.0]}).spec
    assert action_of(spec, ("KeyW",), [0.5, 1.0, 0.0]).tolist() == [[2.0, 1.0, 0.0]]


@pytest.mark.parametrize("held", [("KeyW", "KeyS"), ("KeyS", "KeyW")])
def test_of_two_opposite_keys_the_positive_one_counts(held):
    spec = Robot(keys={"KeyW": [1.0, 0.0, 0.0], "KeyS": [-1.0, 0.0, 0.0]}).spec
    assert action_of(spec, held).tolist() == [[1.0, 0.0, 0.0]]


def test_of_several_choices_each_obeys_the_key_pressed_last():
    spec = spec_of(spaces.MultiDiscrete([3, 3, 2]), idle=(0.0, 1.0, 0.0))
    keys = {"KeyA": [1.0, 1, 0], "KeyD": [2.0, 1, 0], "KeyW": [0.0, 0, 0], "Space": [0.0, 1, 1]}
    spec = replace(spec, keys=keys)
    assert action_of(spec).tolist() == [[0, 1, 0]]
    assert action_of(spec, ("KeyA", "KeyW", "Space")).tolist() == [[1, 0, 1]]
    assert action_of(spec, ("KeyA", "KeyD")).tolist() == [[2, 1, 0]]
    spec.check_action(action_of(spec, ("KeyD", "Space")), 1)


def test_whole_axes_get_whole_numbers():
    spec = spec_of(spaces.Box(-3, 3, (1,), np.int64))
    assert action_of(spec, (), [1.6]).tolist() == [[2]] and axes_of(spec)[0]["whole"]


def test_a_policy_drives_until_somebody_touches_the_controls():
    seen = []

    def full_speed(observation, rng):
        seen.append(set(observation))
        return action_of(world.spec, (), (2.0, 0.0, 0.0))

    world = Robot()
    timeline = Timeline([world], 0, policy=Reactive(full_speed))
    for _ in range(3):
        timeline.step()
    assert seen == [set(world.spec.channels)] * 3, "it sees all that the world shows"
    timeline.step((), (-1.0,))
    assert len(seen) == 3, "a person has taken over"
    timeline.driver.let(False)
    timeline.step()
    assert len(seen) == 3


def test_a_policy_begins_anew_with_each_episode_and_after_a_rewind():
    begun = []

    class Counting(Random):
        def begin(self, batch, rng):
            begun.append(batch)
            return super().begin(batch, rng)

    world = Robot()
    timeline = Timeline([world], 0, policy=Counting(world.spec))
    first = [timeline.step().images for _ in range(6)]
    timeline.restart(0)
    assert [timeline.step().images for _ in range(6)] == first, "a seed is an episode, driven or not"
    timeline.stand_at(2)
    timeline.branch()
    timeline.step()
    assert begun == [1, 1, 1]


def test_other_cameras_are_shown_when_asked_for():
    timeline = Timeline([Robot()], 0)
    assert [image[:2] for image in timeline.step().images] == [(0, 0)]
    timeline.look(["rgb", "rgb.wrist"])
    both = timeline.step()
    assert [image[:2] for image in both.images] == [(0, 0), (0, 1)]
    timeline.look(["rgb.wrist"])
    assert [image[:2] for image in timeline.images(both)] == [(0, 1)], "the past through the camera of now"
    timeline.look(["no.such"])
    assert [image[:2] for image in timeline.step().images] == [(0, 0)]
    assert len(timeline.pictures()) == 1, "a clip has pictures of the same cameras"


def test_two_forkable_worlds_rewind_and_branch():
    timeline = Timeline([Robot(), Robot()], 0)
    first = [timeline.step((), (1.0,)).images for _ in range(8)]
    timeline.stand_at(3)
    timeline.branch()
    assert [timeline.step((), (1.0,)).images for _ in range(5)] == first[3:]


def test_play_with_axes_is_recorded_through_every_camera_and_can_be_viewed(tmp_path):
    world = Robot()
    layout = Layout.of(world.spec)
    timeline = Timeline([world], 0, lambda: Recorder(tmp_path / "set", layout, "play"))
    timeline.record(True)
    for _ in range(12):
        timeline.step((), (1.0, 0.5, 0.25))
    timeline.record(False)
    assert timeline.notice.startswith("saved")
    recording = browse(str(tmp_path / "set"))
    sensors = {sensor["name"]: sensor for sensor in recording.about()["sensors"]}
    assert sensors["action"]["names"] == list(NAMES) and sensors["action"]["units"] == list(UNITS)
    assert np.allclose(recording.series(0, "action")[0], [1.0, 0.5, 0.25])
    sizes = {recording.reading(0, name, 3).shape for name, sensor in sensors.items() if sensor["kind"] == "image"}
    assert sizes == {(48, 64, 3), (32, 32, 3)}


def test_axes_and_cameras_over_the_wire(serve_world):
    world = Robot()
    with Client(serve_world([world]).socket_url) as client:
        hello = client.event("hello")["worlds"][0]
        assert [camera["name"] for camera in hello["cameras"]] == ["main", "wrist"]
        assert hello["action_mode"] == "velocity" and hello["action_frame"] == "body"
        client.say("controls", id=1, held=[], axes=[2.0, 0.0, 1.0], t=5.0)
        while client.frame().action_id != 1:
            pass
        client.say("show", map=False, invented=False, cameras=["rgb", "rgb.wrist"])
        while len((frame := client.frame()).images) != 2:
            pass
        assert [image.camera for image in frame.images] == [0, 1]


def test_show_has_the_main_camera_by_default():
    assert Show(True, False).cameras == ()


def slide(page, at: int, value: float) -> None:
    page.locator("#axes input").nth(at).evaluate(
        "(node, value) => { node.value = value; node.dispatchEvent(new Event('input')); }", value
    )


def test_sliders_show_the_axes_and_set_them(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Robot()]).url)
    assert page.locator("#axes b").all_text_contents() == ["forward", "turn", "gripper"]
    assert page.locator("#axes i").first.text_content() == "−12"
    slide(page, 0, 1.5)
    until(page, "terrella.axes[0] === 1.5")
    assert page.locator("#axes output").first.text_content() == "1.5 m/s"
    page.locator("#axes label").first.dblclick(position={"x": 4, "y": 4})
    until(page, "terrella.axes[0] === 0")
    until(page, "terrella.latencyCount >= 1")


def test_sticks_are_analogue_and_let_go(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Robot()]).url)
    page.evaluate(PAD)
    page.evaluate("() => { window.pad.axes = [0, -0.55, 0, 0]; }")  # half of the way, the dead zone apart
    until(page, "Math.abs(terrella.axes[0] - 1) < 1e-6 && terrella.axes[1] === 0")
    page.evaluate("() => { window.pad.axes = [0, 1, 1, 0]; }")
    until(page, "terrella.axes[0] === -1 && terrella.axes[1] === -2")  # radians count to the left
    page.evaluate("() => { window.pad.axes = [0, 0, 0, 0]; }")
    until(page, "terrella.axes.every((value) => value === 0)")
    assert page.evaluate("terrella.held") == [], "no detour over keys"


def test_a_stick_moves_a_position_and_leaves_it_there(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Robot("position")]).url)
    page.evaluate(PAD)
    page.evaluate("() => { window.pad.axes = [0, -1, 0, 0]; }")
    until(page, "terrella.axes[0] > 0.2")
    page.evaluate("() => { window.pad.axes = [0, 0, 0, 0]; }")
    until(page, "window.last === (window.last = terrella.axes[0])")
    assert page.evaluate("terrella.axes[0]") > 0.2


def test_the_keys_of_a_world_with_axes_are_its_sticks_and_its_sliders(serve_world, open_page):  # noqa: F811
    keys = {"KeyW": [2.0, 0.0, 0.0], "KeyS": [-1.0, 0.0, 0.0], "ArrowLeft": [0.0, 2.0, 0.0]}
    page = open_page(serve_world([Robot(keys=keys)]).url)
    page.keyboard.down("KeyW")
    until(page, "document.querySelector('#axes output').textContent === '2 m/s'")
    assert page.evaluate("terrella.held") == ["KeyW"]
    page.keyboard.up("KeyW")
    until(page, "document.querySelector('#axes output').textContent === '0 m/s'")


def test_the_mouse_looks_around_while_the_picture_holds_it(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Robot()]).url)
    page.evaluate("""() => {
      const screens = document.getElementById('screens');
      Object.defineProperty(document, 'pointerLockElement', { get: () => (window.locked ? screens : null) });
      screens.requestPointerLock = () => { window.locked = true; document.dispatchEvent(new Event('pointerlockchange')); };
    }""")
    page.mouse.click(640, 200)
    until(page, "window.locked")
    page.evaluate("""() => { window.moving = setInterval(() => document.getElementById('screens').dispatchEvent(
      new MouseEvent('mousemove', { movementX: 12 })), 5); }""")
    until(page, "terrella.axes[1] < -0.2")
    page.evaluate("clearInterval(window.moving)")
    until(page, "terrella.axes[1] === 0")
    page.evaluate("() => { window.locked = false; document.dispatchEvent(new Event('pointerlockchange')); }")


def test_cameras_are_switched_on_the_page(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Robot()]).url)
    assert page.locator("#cameras button").all_text_contents() == ["main", "wrist", "all"]
    page.click("#cameras button >> nth=1")
    until(
        page, "document.querySelectorAll('figure').length === 1 && document.querySelector('figure canvas').width === 32"
    )
    page.keyboard.press("KeyC")
    until(page, "document.querySelectorAll('figure').length === 2")
    assert page.locator("figcaption").all_text_contents() == ["main", "wrist"]
    boxes = [page.locator("figure").nth(at).bounding_box() for at in range(2)]
    assert boxes[0]["height"] == pytest.approx(boxes[1]["height"], abs=2) and boxes[1]["x"] > boxes[0]["x"]
    assert boxes[1]["width"] == pytest.approx(boxes[1]["height"], abs=2), "no picture is stretched"


def test_a_policy_is_switched_on_the_page(serve_world, open_page):  # noqa: F811
    world = Robot()
    page = open_page(serve_world([world], policy=Random(world.spec)).url)
    until(page, "terrella.driving")
    page.keyboard.press("KeyG")
    until(page, "!terrella.driving")
    page.click("#drive")
    until(page, "terrella.driving")
