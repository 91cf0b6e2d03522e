"""The contract of each kind of part, held by every implementation of it."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from terrella.core import State, chance, make_rng
from terrella.core.errors import ObservationError
from terrella.worlds.body import FASTEST_M, NoBody
from terrella.worlds.config import VideoConfig
from terrella.worlds.controls import Controls
from terrella.worlds.flow import FlowConfig, FlowNetwork
from terrella.worlds.folder import KINDS
from terrella.worlds.frame_history import FrameHistory, StartClips
from terrella.worlds.generator import Conditioning, DrawnFrame, UNet, decode
from terrella.worlds.learned import About, LearnedWorld
from terrella.worlds.localisation import NoEstimator
from terrella.worlds.objects import NoObjects
from terrella.worlds.parts import (
    Absent,
    Body,
    Channels,
    Evidence,
    Generator,
    Objects,
    Outcome,
    Scene,
    Uncertainty,
    Walls,
    WorldPart,
    newest_frame,
)  # fmt: skip
from terrella.worlds.uncertainty import (
    Expected,
    NoUncertainty,
    UncertaintyConfig,
    UncertaintyNetwork,
    UncertaintyProbe,
)

from .made import place

B, SIZE = 3, (16, 32)
BUTTONS = Controls.buttons(3)


def flat(kind: str) -> LearnedWorld:
    """A frames-only world whose pictures a U-Net or a flow network draws."""
    torch.manual_seed(0)
    config = VideoConfig((1.0, 1.0, 0.5, 0.5), 3, SIZE, (8, 8), slots=3, geometry=False)
    frames = torch.randint(0, 256, (4, 3, 3, *SIZE), dtype=torch.uint8, generator=make_rng(0))
    if kind == "unet":
        scene, generator = FrameHistory(config.frames, StartClips.of(frames, 3)), UNet(config.generator)
        return LearnedWorld(About("flat", BUTTONS, 0.1), scene=scene, generator=generator)
    moves = ((0, 0), (1, 0), (0, 1))
    scene = FrameHistory(type(config.frames)(SIZE, 3, 3, moves), StartClips.of(frames, 3))
    generator = FlowNetwork(FlowConfig(SIZE, 3, config.generator.context, len(moves) - 1, (8, 8, 8)))
    generator.moves.copy_(torch.tensor(moves))
    return LearnedWorld(About(kind, BUTTONS, 0.1), scene=scene, generator=generator)


WORLDS = {
    "still": lambda: place(BUTTONS),
    "moving": lambda: place(BUTTONS, moving=True),
    "things": lambda: place(BUTTONS, moving=True, objects=True),
    "flat": lambda: flat("unet"),
    "flow": lambda: flat("flow"),
}
PROTOCOLS = {"body": Body, "scene": Scene, "generator": Generator, "objects": Objects, "outcome": Outcome}


@pytest.fixture(params=WORLDS)
def world(request) -> LearnedWorld:
    return WORLDS[request.param]()


def walked(world: LearnedWorld, steps: int = 2) -> tuple[State, State, torch.Tensor]:
    """A state, the state one step on whose frame is not yet drawn, and the encoded action between them."""
    rng = make_rng(1)
    state = world.start(B, rng)
    for _ in range(steps):
        state = world.imagine(state, world.spec.sample_action(B, rng), rng)
    numbers = world.controls.encode(world.spec.sample_action(B, rng))
    return *world.move(state, numbers), numbers


def entries(given: dict[str, torch.Tensor], state: State) -> None:
    """Entries of a state, of its batch and of the types and shapes that it has."""
    for name, tensor in given.items():
        assert tensor.shape == state[name].shape and tensor.dtype == state[name].dtype, name


def test_these_worlds_have_a_part_of_every_kind_that_a_folder_can_name():
    built = [world().parts for world in WORLDS.values()]
    has = {(name, part.kind) for parts in built for name, part in parts.items()} - {(name, "none") for name in KINDS}
    named = {(name, kind) for name, kinds in KINDS.items() for kind in kinds}
    assert named - has == {("uncertainty", "network"), ("estimator", "network")}, (
        "these two are made below, or no Protocol"
    )


def test_every_part_keeps_its_protocol(world):
    for name, part in world.parts.items():
        assert isinstance(part, WorldPart) and isinstance(part, PROTOCOLS.get(name, WorldPart)), name
        assert part.kind in KINDS[name] or part.kind == Absent.kind
        assert part.kind == Absent.kind or isinstance(part.config, KINDS[name][part.kind][0])
        assert type(part.to("cpu")) is type(part)


def test_an_absent_part_is_falsy_and_shows_nothing():
    for part in (NoBody(), NoObjects(), NoUncertainty(), NoEstimator()):
        assert not part and part.channels() == Channels() and part.to("meta") is part and part.config is None


def test_a_body_stands_still_moves_and_ends(world):
    body, (before, after, numbers) = world.body, walked(world)
    pose = before["pose"] if "pose" in before else None
    seen = Evidence(B, world.device, pose)
    begun = body.observe(None, seen)
    entries(begun, before)
    entries(body.observe(before, seen), before)
    assert all(not part.any() for name, part in begun.items() if name != "pose"), "without a prior it stands"
    acts = torch.cat([before["actions"], numbers[:, None]], 1)
    before, walls = world.scene.walls(before)
    step = body.step(before, acts, walls, world.scene.recorded.pose[:, :3])
    entries(step, after)
    assert set(step) == set(begun), "each step gives all that a body has"
    ends = body.ends(after, numbers)
    assert ends.shape == (B,) and ends.dtype == torch.bool and body.history <= world.history and body.half_m >= 0


def test_a_body_that_evidence_puts_far_away_has_no_speed():
    body = place(BUTTONS).body
    prior = State({"pose": torch.zeros(2, 7), "speed": torch.zeros(2, 2), "dreamt": torch.zeros(2, dtype=torch.bool)})
    pose = torch.zeros(2, 7)
    pose[:, 0] = torch.tensor([0.99, 1.01]) * FASTEST_M
    speed = body.observe(prior, Evidence(2, torch.device("cpu"), pose))["speed"]
    assert torch.allclose(speed, torch.tensor([[0.99 * FASTEST_M, 0.0], [0.0, 0.0]]))


def test_an_episode_that_is_over_is_drawn_no_more():
    before, _, _ = walked(world := place(BUTTONS))
    over = torch.tensor([True, False, True])
    before = before.replace(done=over)
    after = world.imagine(before, world.spec.sample_action(B, make_rng(4)), make_rng(5))
    shown = [newest_frame(state)[over] for state in (before, after)]
    assert torch.equal(*shown) and torch.equal(before["uncertainty"][over], after["uncertainty"][over])
    assert not torch.equal(newest_frame(before)[~over], newest_frame(after)[~over])


def test_a_scene_starts_looks_takes_the_frame_and_renders(world):
    scene, seeds = world.scene, chance.seeds(B, make_rng(0), world.device)
    evidence, pick = scene.start(seeds)
    assert (
        evidence.batch == B
        and pick.shape == (B,)
        and evidence.seen
        and (evidence.pose is None) == (scene.camera is None)
    )
    again, _ = scene.start(seeds)
    assert all(torch.equal(part, again.seen[name]) for name, part in evidence.seen.items()), "by its seeds alone"
    before, after, _ = walked(world)
    frame_before = newest_frame(before).clone()
    shown = scene.look(after, before)
    assert isinstance(shown, Conditioning) and shown.glimpse.depth.shape == (B, *SIZE)
    assert shown.last.shape[0] == B and shown.last.shape[2:] == SIZE and shown.familiar.shape == (B, 2)
    assert scene.config.slots == shown.glimpse.rgb.shape[1]
    rgb = torch.full((B, 3, *SIZE), 7, dtype=torch.uint8)
    deep = torch.full((B, *SIZE), 2.0)
    moving = "things" in before
    frame = DrawnFrame(rgb, deep, 0 * deep if moving else None) if scene.camera else DrawnFrame(rgb)
    taken = scene.take(after, world.generator.prepare(shown), frame)
    assert torch.equal(newest_frame(taken), rgb) and torch.equal(newest_frame(before), frame_before), (
        "a state is a value"
    )
    entries({name: taken[name] for name in scene.drawn_names if name in taken}, before)
    assert set(scene.earlier_names) <= set(before) and all(f"earlier_{name}" in before for name in scene.earlier_names)
    after_it = world.take(after, before, world.look(after, before), torch.zeros(B, 5 if moving else 4, *SIZE))
    for name in scene.earlier_names:
        assert torch.equal(after_it[f"earlier_{name}"], before[name]), "what the frame before the last was"
    channels = scene.channels().shows
    for name, tensor in scene.render(taken, tuple(channels)).items():
        assert tensor.shape == (B, *channels[name].shape), name
    assert not scene.render(taken, ())


def test_a_scene_takes_evidence_into_a_new_episode_and_into_one_that_goes_on(world):
    scene, (state, _, _) = world.scene, walked(world)
    seen = world.render(state, world.spec.observes)
    for prior in (None, state):
        evidence = scene.evidence(seen, prior, world.estimator)
        observed = scene.observe(prior, evidence)
        assert torch.equal(newest_frame(observed), newest_frame(state)) and scene.adopt(observed).batch == B
    with pytest.raises(ObservationError, match="observes"):
        scene.evidence({}, state, world.estimator)
    with pytest.raises(ObservationError, match="prior holds"):
        scene.evidence(seen, state.at([0]), world.estimator)


def test_a_scene_gives_walls_and_keeps_its_memory_apart(world):
    scene, (state, _, _) = world.scene, walked(world)
    same, walls = scene.walls(state)
    assert isinstance(walls, Walls) and walls.shared.shape[1:] == (4,) and walls.own.shape[::2] == (B, 4)
    assert same == state, "drawn or not, it is the same state"
    bare = scene.with_memory(recorded=scene.recorded.at(slice(0, 0)))
    assert len(bare.recorded) == 0 and type(bare) is type(scene) and bare.starts is scene.starts
    small = scene.with_memory(budget_mb=0.0)
    assert small.recorded is scene.recorded or not len(scene.recorded)


def test_a_generator_draws_by_its_noise(world):
    before, after, _ = walked(world)
    shown = world.generator.prepare(world.scene.look(after, before))
    planes = 5 if "things" in before else 4
    noise = torch.randn(B, 4, *SIZE, generator=make_rng(0))
    clean = world.generator.draw(noise, shown)
    assert clean.shape == (B, planes, *SIZE) and world.generator.config.steps >= 1
    assert torch.equal(clean, world.generator.draw(noise, shown))
    one = world.generator.draw(noise[1:2], shown.at(slice(1, 2)))
    assert (one - clean[1:2]).abs().max() < 1e-4
    frame = decode(clean, posed=world.scene.camera is not None)
    assert frame.rgb.dtype == torch.uint8 and frame.rgb.shape == (B, 3, *SIZE)
    assert (frame.depth is None) == (world.scene.camera is None) and (frame.things is None) == (planes == 4)
    for part in fields(shown):
        held = getattr(shown.to("cpu"), part.name)
        assert (held is None) == (getattr(shown, part.name) is None), part.name


def test_objects_start_act_are_painted_and_stop_bodies(world):
    objects, (before, after, _) = world.objects, walked(world)
    camera, chances = world.scene.camera, chance.uniforms(chance.seeds(B, make_rng(0)), objects.draws)
    entries(objects.start(torch.zeros(B, dtype=torch.long), before), before)
    step = objects.step(before, after, chances)
    entries(step, before)
    assert all(torch.equal(part, objects.step(before, after, chances)[name]) for name, part in step.items())
    none = Walls(torch.zeros(0, 4), torch.zeros(B, 0, 4))
    assert objects.add_walls(none, before, 0.1).own.shape[::2] == (B, 4)
    if objects:
        assert torch.equal(objects.add_walls(none, before, 0.1).own, objects.bodies(before, 0.1)), "they stop bodies"
    deep = torch.full((B, *SIZE), 2.0)
    frame = DrawnFrame(torch.full((B, 3, *SIZE), 7, dtype=torch.uint8), deep, 0 * deep)
    painted = objects.paint(before, frame, camera)
    assert painted.rgb.shape == frame.rgb.shape and painted.rgb.dtype == torch.uint8
    assert (painted.instances is None) == (not objects) and (frame.rgb == 7).all(), (
        "what was drawn is not changed in place"
    )
    channels = objects.channels(SIZE).shows
    for name, tensor in objects.render(before, tuple(channels)).items():
        assert tensor.shape == (B, *channels[name].shape), name
    evidence = world.scene.evidence(world.render(before, world.spec.observes), before, world.estimator)
    entries(objects.observe(None, evidence, {}, camera), before)


def test_an_outcome_begins_steps_and_renders(world):
    outcome, (before, _, numbers) = world.outcome, walked(world)
    seen = Evidence(B, world.device)
    begun = outcome.observe(None, seen, {})
    entries(begun, before)
    assert not begun["reward"].any() and not begun["done"].any(), "an episode that begins goes on"
    assert len(outcome.begins) == begun.get("vitals", torch.zeros(B, 0)).shape[1]
    drawn = world.imagine(before, world.spec.sample_action(B, make_rng(0)), make_rng(0))
    ends = torch.tensor([True, False, False])
    chances = chance.uniforms(chance.seeds(B, make_rng(0)), outcome.draws)
    step = outcome.step(before, drawn, lambda: ends, numbers, chances)
    entries(step, before)
    if outcome.kind == "constant":
        usual, ending = outcome.config.usual, outcome.config.ending
        assert step["done"].tolist() == ends.tolist() and step["reward"].tolist() == pytest.approx(
            [usual + ending, usual, usual]
        )
    channels = outcome.channels().shows
    assert {"reward", "done"} <= set(channels)
    for name, tensor in outcome.render(drawn, tuple(channels)).items():
        assert tensor.shape == (B, *channels[name].shape), name


@pytest.mark.parametrize("made", [lambda: UncertaintyNetwork(UncertaintyConfig()), NoUncertainty, "probe"])
def test_an_uncertainty_says_an_error_for_each_entry(made):
    world, noted = place(BUTTONS), []
    part = UncertaintyProbe(lambda *given: noted.append(given)) if made == "probe" else made()
    assert isinstance(part, Uncertainty) and bool(part) == (made is not NoUncertainty)
    before, after, _ = walked(world)
    shown = world.look(after, before)
    clean = world.generator.draw(torch.randn(B, 4, *SIZE, generator=make_rng(0)), shown)
    gone = torch.tensor([[1.0, 0, 0, 0, 0], [400.0, 90, 20, 0, 0], [1.0, 0, 0, 1, 1]])
    whole, drifted, invented = part.expected(shown, clean, gone)
    for expected in (whole, drifted, invented):
        assert expected.shape == (B,) and expected.dtype == torch.float32 and ((expected >= 0) & (expected <= 1)).all()
    assert torch.allclose(whole, drifted + invented) and (made in (NoUncertainty, "probe") or drifted[1] > drifted[0])
    assert set(part.channels().shows) <= {*Expected._fields} and len(noted) == (made == "probe")
