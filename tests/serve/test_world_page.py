"""A learned world as one HTML file: in the browser its network draws what PyTorch draws, whatever memory it has."""

from __future__ import annotations

import pytest
import torch

import terrella
from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.serve.actions import action_of
from terrella.space.mosaic import empty_mosaic, write_mosaic
from terrella.workflows.export_world import export_world, page_of
from terrella.worlds.config import HistoryConfig
from terrella.worlds.controls import AXES, Controls
from terrella.worlds.flow import FlowConfig, FlowNetwork
from terrella.worlds.frame_history import FrameHistory, StartClips
from terrella.worlds.learned import About, LearnedWorld
from terrella.worlds.parts import Evidence

ACTION = """(codes) => {
  codes.forEach((code) => terrella.press(code, true));
  const action = terrella.action();
  codes.forEach((code) => terrella.press(code, false));
  return action;
}"""
STEP = """([state, action, noise, steps]) => {
  const { world } = terrella, now = state === null ? window.now : world.start(state);
  window.now = world.step(now, action, Float32Array.from(noise), steps);
  return [...window.now.frames[0]];
}"""


def made(size: tuple[int, int], moves: int = 0, recalls: bool = False) -> LearnedWorld:
    """A world of random weights, whose pictures change a lot."""
    torch.manual_seed(1)
    slots, actions = 3, 3
    network = FlowNetwork(FlowConfig(size, slots, 36 + slots * actions, moves, (16, 24, 32), 3, recalls, normed=True))
    with torch.no_grad():
        network.output.weight.normal_(0, 0.1)
        network.norm.weight.normal_(1, 0.2)
        network.norm.bias.normal_(0, 0.2)
        if network.scrolling is not None:
            network.scrolling.votes.weight.normal_(0, 2)
        for weight in network.parameters():
            weight.copy_(weight.half())
        network.moves[:, 0], network.moves[:, 1] = torch.arange(moves + 1), -2 * torch.arange(moves + 1)
        network.over[:5, :9] = moves > 0
    settings = HistoryConfig(
        size, slots, actions, tuple(map(tuple, network.moves.tolist())) if moves else (), recalls=recalls
    )
    frames = torch.rand(3, slots, 3, *size, generator=make_rng(2)) * 255
    starts = StartClips(
        frames.byte(),
        torch.rand(3, slots, actions).round(),
        torch.zeros(3, 0),
        torch.zeros(3, 4, *size, dtype=torch.uint8),
    )
    about = About(
        "made", Controls.buttons(actions), 0.1, ("left", "right", "jump"), {"KeyA": [1, 0, 0], "Space": [0, 0, 1]}
    )
    return LearnedWorld(about, scene=FrameHistory(settings, starts, network.over), generator=network.eval())


def in_python(
    world: LearnedWorld, start: int, actions: list[torch.Tensor], noises: list[torch.Tensor]
) -> list[torch.Tensor]:
    """The frames of a rollout from a start, each drawn from the given noise."""
    clips = StartClips(*(part[start : start + 1] for part in vars(world.scene.starts).values()))
    seen = {"frames": clips.frames, "actions": clips.actions.flip(1), "vitals": clips.vitals}
    if world.scene.config.moves:
        seen["mosaic"] = write_mosaic(empty_mosaic(1, world.size), clips.known)
    state, frames = world._observed(Evidence(1, world.device, None, seen), {}, None), []
    for action, noise in zip(actions, noises):
        now, after = world.move(state, action)
        shown = world.look(after, now)
        state = world.take(after, now, shown, world.generator.draw(noise, shown))
        frames.append(state["frames"][0, 0].permute(1, 2, 0))
    return frames


@pytest.fixture
def opened(browser, tmp_path):
    def opened(world: LearnedWorld):
        file = tmp_path / "world.html"
        file.write_bytes(page_of(world, world.generator))
        page = browser.new_page()
        errors = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
        page.goto(file.as_uri())
        page.wait_for_selector("body[data-state=playing], body[data-state=failed]")
        assert not errors and page.text_content("#pace").count("frames a second") <= 1
        page.click("#pause")
        return page

    return opened


WORLDS = {
    "frames alone, no multiple of 16": lambda: made((40, 56)),
    "pictures scroll": lambda: made((48, 64), moves=3),
    "earlier frames are recalled": lambda: made((32, 40), recalls=True),
    "islet": lambda: terrella.load("islet"),
}


@pytest.mark.browser
@pytest.mark.parametrize("name", WORLDS)
@torch.no_grad()
def test_the_page_draws_what_pytorch_draws(opened, name):
    world = WORLDS[name]()
    page, rng, width = opened(world), make_rng(3), world.controls.numbers
    actions = [torch.eye(width)[number % width][None] for number in range(5)]
    noises = [torch.randn(1, 4, *world.size, generator=rng) for _ in actions]
    for number, frame in enumerate(in_python(world, 0, actions, noises)):
        noise = noises[number][0, :3].permute(1, 2, 0).flatten().tolist()
        drawn = page.evaluate(STEP, [None if number else 0, actions[number][0].tolist(), noise, 3])
        off = (torch.tensor(drawn).view(*world.size, 3) - frame.int()).abs()
        assert off.max() <= 2 and (off > 0).float().mean() < 1e-2, f"step {number}: {off.max()}"


@pytest.mark.browser
def test_axes_of_opposite_keys_and_odd_limits(opened):
    """As serve/actions.py has it: of two opposites the positive, within the limits."""
    world = made((32, 32))
    controls = Controls(AXES, (-0.4, -1.0, 0.0), (0.4, 1.0, 0.5))
    about = About(
        "axes",
        controls,
        0.1,
        ("steer", "turn", "gas"),
        {"KeyA": [-0.4, 0, 0], "KeyD": [0.4, 0, 0], "KeyW": [0, 0, 9.0]},
    )
    page = opened(LearnedWorld(about, scene=world.scene, generator=world.generator))
    for codes in (["KeyA", "KeyD"], ["KeyD", "KeyA"], ["KeyA"], ["KeyW", "KeyA"], []):
        wanted = action_of(LearnedWorld(about, scene=world.scene, generator=world.generator).spec, codes)[0].tolist()
        assert page.evaluate(ACTION, codes) == pytest.approx(wanted)
    assert [text.removeprefix(code) for text, code in zip(page.locator("#keys button").all_text_contents(), "ADW")][
        :2
    ] == ["steer −", "steer +"]


@pytest.mark.browser
def test_one_plays_by_keys_and_by_buttons(opened):
    page = opened(made((32, 32)))
    assert page.evaluate("document.title") == "made · Terrella" and page.locator("#keys button").count() == 2
    assert page.evaluate(ACTION, []) == [0, 0, 0]
    assert page.evaluate(ACTION, ["KeyA"]) == [1, 0, 0] and page.evaluate(ACTION, ["Space", "KeyA", "KeyX"]) == [
        1,
        0,
        1,
    ]
    page.click("#pause")
    for press, release, part in (
        (lambda: page.keyboard.down("Space"), lambda: page.keyboard.up("Space"), 2),
        (lambda: (page.locator("#keys button").first.hover(), page.mouse.down()), page.mouse.up, 0),
    ):
        for act, down in ((press, 1), (release, 0)):
            act()
            wait_for(page, f"terrella.state.actions.at(-1)[{part}] === {down}")


def wait_for(page, condition: str) -> None:
    """Until it is true on the page, 10 s at most; the page's policy forbids playwright's own way."""
    for _ in range(200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"{condition} did not come")


def test_what_a_browser_cannot_run_is_refused(tmp_path):
    with pytest.raises(TerrellaError, match="no learned world of frames alone"):
        export_world("doom-maze", tmp_path / "maze.html")
    with pytest.raises(TerrellaError, match="ends in .html"):
        export_world("islet", tmp_path / "islet.onnx")
    assert not list(tmp_path.iterdir())
