"""Who drives: an agent acts when it is let, a touch takes over in the same step, and what it raises is told, never fatal."""

from __future__ import annotations

import base64
import io

import pytest
import torch
from gymnasium import spaces
from PIL import Image

from terrella.act.planning import FullyObserved, Planner, SearchConfig, distance_to, imagined_futures
from terrella.core.errors import ContractError, PlanningError, ProtocolError, ServeError
from terrella.core.policy import Idle, Reactive
from terrella.core.spec import Spec
from terrella.core.world import make_rng
from terrella.serve.actions import action_of, keys_of
from terrella.serve.agent import Agent, Agents
from terrella.serve.driver import NO_GOAL
from terrella.serve.picture import picture_of
from terrella.serve.protocol import GOAL_MARK, Goal, parse_message
from terrella.serve.timeline import Timeline

from .mapped import Mapped
from .panorama import BUTTONS, Panorama
from .test_page import open_page, until  # noqa: F401  (a fixture)
from .test_session import FakeSocket, Session, asyncio
from .test_session import until as happens


def pressing(*names: str) -> torch.Tensor:
    return torch.tensor([[float(name in names) for name in BUTTONS]]).to(torch.int8)


def walker(**more) -> Agents:
    return Agents(lambda goal: Agent("a walker", Reactive(lambda seen, rng: pressing("MOVE_FORWARD")), **more))


def test_an_agent_waits_until_it_is_let_and_a_key_takes_over_in_the_same_step():
    timeline = Timeline([Panorama()], 0, policy=walker())
    timeline.step()
    assert timeline.shown.episode_return == 0 and timeline.driver.acted is None
    timeline.driver.let(True)
    timeline.step()
    assert timeline.shown.episode_return == 1 and timeline.driver.name == "a walker"
    assert keys_of(timeline.obeyed, timeline.driver.acted) == ["KeyW"]
    timeline.step(["KeyS"])
    assert timeline.shown.episode_return == 0, "the very step of the key is the person's"
    assert not timeline.driver.on and timeline.driver.acted is None
    timeline.step()
    assert timeline.shown.episode_return == 0, "and the agent does not come back by itself"


def test_a_key_of_another_keyboard_touches_nothing():
    timeline = Timeline([Panorama()], 0, policy=walker())
    timeline.driver.let(True)
    timeline.step(["KeyZ"])
    assert timeline.driver.on and timeline.shown.episode_return == 1


@pytest.mark.parametrize("fault", ["error", "sentence", "nan", "shape", "made"])
def test_an_agent_that_fails_is_told_in_a_sentence_and_the_person_drives(fault, capsys):
    def act(seen, rng):
        if fault == "error":
            raise RuntimeError("the paint is wet")
        if fault == "sentence":
            raise PlanningError("none of 8 plans has a cost that is a finite number.")
        return torch.full((1, 6), torch.nan) if fault == "nan" else torch.zeros(1, 5)

    def make(goal):
        if fault == "made":
            raise PlanningError("there is no reward to plan for.")
        return Agent("a stranger", Reactive(act))

    timeline = Timeline([Panorama()], 0, policy=Agents(make))
    timeline.driver.let(True)
    timeline.step()
    said = timeline.driver.notice
    assert not timeline.driver.on and said.startswith("the agent stopped: ") and said.endswith("You drive.")
    words = {"error": "RuntimeError: the paint is wet", "sentence": "finite", "nan": "finite", "shape": "shape"}
    assert words.get(fault, "no reward") in said
    assert timeline.shown.episode_return == 0, "nothing is done in its place"
    timeline.step(["KeyW"])
    assert timeline.shown.episode_return == 1
    timeline.driver.let(True)
    assert timeline.driver.notice == ""


def test_a_goal_that_is_reached_ends_the_drive():
    def away(state) -> float:
        return 1.0 - float(state["x"][0])

    timeline = Timeline([Panorama()], 0, policy=walker(away=away, near=0.55, unit="m"))
    timeline.driver.let(True)
    for _ in range(8):
        timeline.step()
    assert not timeline.driver.on and timeline.driver.notice == "reached: 0.5 m from the goal. You drive."
    assert float(timeline._states[0]["x"][0]) == pytest.approx(0.5), "and it goes no further"


@pytest.mark.parametrize("away", [3.0, float("nan")])
def test_a_goal_that_does_not_come_nearer_ends_the_drive(away):
    timeline = Timeline([Panorama(dt_s=0.5)], 0, policy=walker(away=lambda state: away, near=0.5, unit="m"))
    timeline.driver.let(True)
    for _ in range(30):
        timeline.step()
    assert not timeline.driver.on and ("cannot be reached" in timeline.driver.notice) == (away == 3.0)
    assert timeline.driver.notice.endswith("You drive.")


def test_after_a_rewind_the_agent_remembers_nothing():
    class Counting(Idle):
        begun = 0

        def begin(self, batch, rng):
            Counting.begun += 1
            return super().begin(batch, rng)

    world = Panorama()
    timeline = Timeline([world], 0, policy=Agents(lambda goal: Agent("a counter", Counting(world.spec))))
    timeline.driver.let(True)
    for _ in range(6):
        timeline.step()
    timeline.stand_at(2)
    timeline.branch()
    timeline.step()
    assert Counting.begun == 2


def spec_of(action: spaces.Space, keys: dict[str, list[float]], **more) -> Spec:
    return Spec(name="test", action=action, channels={}, observes=(), dt_s=0.1, keys=keys, **more)


def test_the_keys_of_an_action_are_those_that_a_person_would_press():
    buttons = Panorama().spec
    assert keys_of(buttons, pressing("MOVE_FORWARD", "TURN_LEFT")) == ["KeyW", "ArrowLeft"], (
        "not the second key for each"
    )
    choice = spec_of(spaces.Discrete(3), {"KeyA": [1], "KeyD": [2], "KeyA+Space": [2], "KeyS": [0]})
    assert keys_of(choice, torch.tensor([1])) == ["KeyA"] and keys_of(choice, torch.tensor([0])) == []
    axes = spec_of(spaces.Box(-1, 1, (2,)), {"KeyW": [1, 0], "KeyS": [-1, 0], "KeyD": [0, -1]})
    assert keys_of(axes, torch.tensor([[0.7, 0.2]])) == ["KeyW"] and keys_of(axes, torch.tensor([[0.2, -0.6]])) == [
        "KeyD"
    ]
    several = spec_of(spaces.MultiDiscrete([3, 2]), {"KeyA": [1, 0], "KeyD": [2, 0], "Space": [0, 1]})
    assert keys_of(several, torch.tensor([[2, 1]])) == ["KeyD", "Space"]
    for spec in (buttons, choice, axes, several):
        for code in (code for code in spec.keys if "+" not in code and code not in ("KeyS", "ArrowUp", "ArrowDown")):
            assert keys_of(spec, action_of(spec, [code]))[:1] in ([code], ["KeyA"])


def test_a_session_tells_who_drives_and_two_pages_have_agents_of_their_own():
    from concurrent.futures import ThreadPoolExecutor

    async def main() -> None:
        with ThreadPoolExecutor(1) as worker:
            make = lambda: Timeline([Panorama(dt_s=1 / 400)], 0, policy=walker())  # noqa: E731
            sessions = [Session(make, worker) for _ in range(2)]
            tasks = [asyncio.create_task(session.run()) for session in sessions]
            sockets = [FakeSocket(session) for session in sessions]
            try:
                for session, socket in zip(sessions, sockets):
                    session.attach(socket)
                sessions[0].hear("drive", True)
                told = lambda socket, kind: [event for event in socket.events if event["type"] == kind]  # noqa: E731
                await happens(lambda: any(event["held"] == ["KeyW"] for event in told(sockets[0], "acted")))
                await happens(lambda: sockets[0].last.episode_return > 0 and len(sockets[1].frames) > 5)
                assert told(sockets[0], "agent")[-1]["name"] == "a walker" and told(sockets[0], "agent")[-1]["driving"]
                assert not any(event["driving"] for event in told(sockets[1], "agent"))
                assert all(frame.episode_return == 0 for frame in sockets[1].frames)
            finally:
                for session in sessions:
                    session.close()
                await asyncio.gather(*tasks)

    asyncio.run(main())


def test_the_page_shows_who_drives_and_a_key_takes_over(serve_world, open_page):  # noqa: F811
    page = open_page(serve_world([Panorama()], policy=walker()).url)
    assert not page.evaluate("terrella.driving") and page.locator("#drive").is_visible()
    page.keyboard.press("KeyG")
    until(page, "terrella.driving && terrella.agent.held.join() === 'KeyW'")
    assert page.locator("#driver-name").text_content() == "A walker drives"
    assert page.locator("#keys kbd.held b").all_text_contents() == ["W"]
    page.keyboard.down("ArrowLeft")
    until(page, "!terrella.driving && terrella.agent.held.length === 0")
    assert page.locator("#driver-name").text_content() == "You drive"
    assert page.locator("#keys kbd.held b").all_text_contents() == ["←"]
    page.keyboard.up("ArrowLeft")


def test_futures_come_in_pieces_only_while_the_agent_drives():
    pieces = []

    def futures(memory):
        for step in range(3):
            pieces.append(step)
            yield None
        yield [(0.5, torch.zeros(4, 96, 128, 3, dtype=torch.uint8)), (float("inf"), torch.zeros(4, 96, 128, 3).byte())]

    timeline = Timeline([Panorama()], 0, policy=walker(futures=futures))
    assert timeline.consider() is None and not pieces
    timeline.driver.let(True)
    timeline.step()
    assert [timeline.consider() for _ in range(3)] == [None] * 3 and pieces == [0, 1, 2]
    found = timeline.consider()
    assert [plan["cost"] for plan in found["plans"]] == [0.5, None] and found["frames"] == 4 and found["step"] == 1
    strip = picture_of(base64.b64decode(found["plans"][0]["image"]), (72, 4 * 96))
    assert strip.float().mean() < 3
    assert timeline.consider() is None and pieces == [0, 1, 2, 0], "and then anew"
    timeline.step(["KeyW"])
    assert timeline.consider() is None and pieces == [0, 1, 2, 0], "nobody considers anything while a person drives"


def test_what_a_planner_considered_is_imagined_anew():
    world = FullyObserved(Panorama())
    cost = distance_to(world, {"pose": torch.tensor([5.0, *[torch.nan] * 6])})
    planner = Planner(world, cost, SearchConfig(samples=8, iterations=1, horizon=5))
    rng = make_rng(0)
    memory = planner.begin(1, rng)
    state = world.start(1, rng)
    assert list(imagined_futures(world, cost, memory[0])) == []
    _, memory = planner.act(world.render(state, world.spec.observes), memory, rng)
    *waiting, found = imagined_futures(world, cost, memory[0], count=4)
    assert waiting == [None] * 6 and 2 <= len(found) <= 3
    assert found[0].cost == pytest.approx(memory[0].decision.cost, rel=1e-5) and found[0].cost == min(found)[0]
    assert all(one.pictures.shape == (4, 48, 64, 3) for one in found)
    assert torch.equal(found[0].pictures[0], world.render(state, ("rgb",))["rgb"][0])


@pytest.mark.parametrize("considers", [True, False])
def test_the_page_draws_what_the_agent_considers(serve_world, open_page, considers):  # noqa: F811
    def futures(memory):
        yield None
        yield [(cost, torch.full((6, 48, 64, 3), 200, dtype=torch.uint8)) for cost in (0.25, 1.0, 4.0)]

    agents = walker(futures=futures if considers else None)
    page = open_page(serve_world([Panorama(dt_s=1 / 100)], policy=agents).url)
    page.keyboard.press("KeyV")
    page.keyboard.press("KeyG")
    if not considers:
        until(page, "document.getElementById('futures-said').textContent.includes('does not plan')")
        return
    until(page, "terrella.agent.futures > 1")
    assert page.locator("#futures li b").all_text_contents() == ["chosen", "middling", "worst"]
    assert page.locator("#futures li span").all_text_contents() == ["cost 0.25", "cost 1", "cost 4"]
    picture, deck = page.locator("figure").bounding_box(), page.locator("#deck").bounding_box()
    strips = page.locator("#futures").bounding_box()
    assert picture["y"] + picture["height"] <= strips["y"] + 1 and strips["y"] + strips["height"] <= deck["y"] + 1
    page.keyboard.press("KeyV")
    until(page, "document.getElementById('futures').hidden")


def place_of(goal) -> tuple[float, float]:
    return tuple(goal["pose"][0, :2].tolist())


def test_a_place_is_driven_to_at_once_a_picture_when_the_agent_is_let(tmp_path):
    asked = []

    def make(goal):
        asked.append(goal)
        return Agent("a walker", Reactive(lambda seen, rng: pressing("MOVE_FORWARD")))

    timeline = Timeline([Mapped()], 0, policy=Agents(make, places=True, pictures=True))
    driver = timeline.driver
    timeline.seek(Goal(at=(1.5, -2.0)))
    timeline.step()
    assert driver.on and place_of(asked[-1]) == (1.5, -2.0) and bool(asked[-1]["pose"][0, 2:].isnan().all())
    assert driver.mark == NO_GOAL | {"at": [1.5, -2.0]}
    timeline.seek(Goal(here=True))
    assert not driver.on and driver.mark["at"] is None and driver.mark["image"]
    timeline.step(["KeyW"])
    driver.let(True)
    timeline.step()
    assert set(asked[-1]) == set(timeline.spec.recorded) and asked[-1]["rgb"].shape == (1, 48, 64, 3)
    data = io.BytesIO()
    Image.new("RGB", (200, 90), "teal").save(data, "PNG")
    timeline.seek(parse_message(GOAL_MARK + data.getvalue())[1])
    timeline.step()
    assert driver.on and set(asked[-1]) == {"rgb"} and asked[-1]["rgb"].shape == (1, 48, 64, 3)
    timeline.seek(Goal())
    timeline.step()
    assert not driver.on and driver.goal == {} and driver.mark == NO_GOAL


def north_or_south(words: str):
    """An instruction as a goal."""
    if not {"north", "south"} & set(words.split()):
        raise ContractError(f"'{words}' names neither north nor south.")
    return {"pose": torch.tensor([[0.0, 3.0 if "north" in words else -3.0, *[torch.nan] * 5]])}


def test_an_instruction_is_driven_at_once_and_forgotten_when_it_is_done():
    far, asked = [5.0], []

    def make(goal):
        asked.append(goal)
        reactive = Reactive(lambda seen, rng: pressing("MOVE_FORWARD"))
        return Agent("a walker", reactive, away=lambda state: far[0], near=0.5)

    timeline = Timeline([Mapped()], 0, policy=Agents(make, words=north_or_south))
    driver = timeline.driver
    timeline.seek(Goal(words="go north"))
    timeline.step()
    assert driver.on and place_of(asked[-1]) == (0.0, 3.0) and driver.mark == NO_GOAL | {"words": "go north"}
    with pytest.raises(ContractError, match="neither"):
        timeline.seek(Goal(words="make tea"))
    assert driver.on and driver.mark["words"] == "go north"
    far[0] = 0.1
    timeline.step()
    assert not driver.on and driver.mark == NO_GOAL and "reached" in driver.notice


def test_an_instruction_is_typed_on_the_page(serve_world, open_page):  # noqa: F811
    words = []

    def said(text):
        words.append(text)
        return north_or_south(text)

    agents = Agents(lambda goal: Agent("a walker", Reactive(lambda seen, rng: pressing("MOVE_FORWARD"))), words=said)
    page = open_page(serve_world([Panorama(dt_s=1 / 100)], policy=agents).url)
    page.click("#words")
    page.keyboard.type("go south by G M")
    page.keyboard.press("Enter")
    until(page, "terrella.agent.goalWords === 'go south by G M'")
    assert words == ["go south by G M"] and page.input_value("#words") == "go south by G M"
    page.click("#words")
    page.fill("#words", "make tea")
    page.keyboard.press("Enter")
    until(page, "document.getElementById('toast').textContent.includes('neither')")
    page.click("#goal-forget")
    until(page, "!terrella.agent.goalWords && !document.getElementById('words').value")


def test_goals_that_nobody_can_seek_are_refused():
    with pytest.raises(ServeError, match="no instructions"):
        Timeline([Mapped()], 0, policy=walker()).seek(Goal(words="go north"))
    for agents, kind in ((None, "walk to a place"), (walker(), "walk to a place")):
        with pytest.raises(ServeError, match=kind):
            Timeline([Mapped()], 0, policy=agents).seek(Goal(at=(0.0, 0.0)))
    with pytest.raises(ServeError, match="seek a picture"):
        Timeline([Mapped()], 0, policy=walker()).seek(Goal(here=True))
    with pytest.raises(ServeError, match="no image"):
        Timeline([Mapped()], 0, policy=Agents(walker().make, pictures=True)).seek(Goal(picture=b"junk"))


@pytest.mark.parametrize(
    "junk",
    [
        '"at": 3',
        '"at": [1]',
        '"at": [1, NaN]',
        '"at": [1, "2"]',
        '"here": 1',
        '"at": [1e30, 0]',
        '"words": 3',
        '"words": "\\u0000"',
        f'"words": "{"a" * 201}"',
    ],
)
def test_a_goal_that_is_none_is_named(junk):
    with pytest.raises(ProtocolError):
        parse_message(f'{{"type": "goal", {junk}}}')
    assert parse_message('{"type": "goal", "at": [1, 2.5]}') == ("goal", Goal((1.0, 2.5)))
    assert parse_message('{"type": "goal", "here": true}') == ("goal", Goal(here=True))
    assert parse_message('{"type": "goal"}') == ("goal", Goal())
    show = '{"type": "show", "map": false, "invented": false, "futures": %s}'
    assert parse_message(show % "true")[1].futures
    with pytest.raises(ProtocolError, match="true or false"):
        parse_message(show % "1")


def test_a_click_on_the_map_is_walked_to_and_told_when_reached(serve_world, open_page):  # noqa: F811
    def make(goal):
        x, y = place_of(goal)

        def steer(seen, rng):
            return pressing("MOVE_FORWARD" if float(seen["pose"][0, 0]) < x else "MOVE_BACKWARD")

        return Agent("a walker", Reactive(steer), away=lambda state: abs(x - float(state["x"][0])), near=0.2, unit="m")

    page = open_page(serve_world([Mapped(dt_s=1 / 100)], policy=Agents(make, places=True)).url)
    until(page, "terrella.map.shown && terrella.map.camera !== null")
    box = page.locator("#map canvas").bounding_box()
    page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + 0.5 * box["height"])
    until(page, "terrella.agent.goal !== null && terrella.driving")
    place = page.evaluate("terrella.agent.goal")
    assert 1 < place[0] < 4 and abs(place[1]) < 0.2, "where the click was, in metres"
    until(page, "!terrella.driving && terrella.agent.said.startsWith('reached: ')")
    until(page, "terrella.agent.goal === null")
    until(page, f"Math.abs(terrella.map.camera[0] - {place[0]}) < 0.5")  # the map is drawn now and then
    assert "Reached" in page.locator("#toast").text_content()
