"""Learned worlds of parts: any kind of action, frames that are drawn when somebody looks, and parts that are exchanged."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces

import terrella
from terrella.core import State, check_world, make_rng
from terrella.core.errors import CheckpointError, ContractError
from terrella.data.channels import facts_of
from terrella.learn.recording import controls_of
from terrella.worlds import learned
from terrella.worlds.controls import AXES, CHOICE, Controls
from terrella.worlds.folder import load_world, save_keys, save_world
from terrella.worlds.generator import UNet
from terrella.worlds.learned import LearnedWorld
from terrella.worlds.uncertainty import UncertaintyConfig, UncertaintyNetwork, UncertaintyProbe

from .made import place

STEERING = Controls(AXES, (-1.0, 0.0), (1.0, 4.0), "velocity", ("m/s", "rad/s"), "body")
KINDS = {"buttons": Controls.buttons(3), "choice": Controls(CHOICE, (2.0,), (5.0,)), "axes": STEERING}


@pytest.mark.parametrize("controls", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize(
    "more", [{}, {"moving": True}, {"moving": True, "objects": True}], ids=["still", "moving", "things"]
)
def test_every_kind_of_action_and_of_parts_keeps_the_contract(controls, more):
    world = place(controls, **more)
    held = check_world(world, steps=3)
    assert {"a_batch_equals_its_singles", "forks_and_puts", "states_can_be_saved"} <= set(held)
    assert world.spec.cameras["rgb"].pose == "pose" and {"rgb", "depth", "pose"} <= set(world.spec.observes)


def test_controls_are_those_of_a_spec_and_the_spec_says_what_axes_mean():
    world = place(STEERING)
    assert Controls.of(world.spec) == STEERING
    assert (world.spec.action_mode, world.spec.action_units, world.spec.action_frame) == (
        "velocity",
        ("m/s", "rad/s"),
        "body",
    )
    assert Controls.of(place(KINDS["choice"]).spec) == KINDS["choice"]


def walk(world: LearnedWorld, look: bool, steps: int = 6, batch: int = 2):
    rng = make_rng(1)
    state = world.start(batch, rng)
    for _ in range(steps):
        state = world.imagine(state, world.spec.sample_action(batch, rng), rng)
        if look:
            world.render(state, ("rgb",))
    return state


def test_a_frame_is_drawn_when_somebody_looks_and_looking_changes_nothing(monkeypatch):
    world, drawn = place(KINDS["buttons"]), []
    real = world.generator.draw
    monkeypatch.setattr(world.generator, "draw", lambda *given: (drawn.append(len(given[0])), real(*given))[1])
    state = walk(world, look=False)
    world.render(state, ("pose", "reward", "done"))
    assert not drawn, "pose, reward and done cost no pixels"
    looked = walk(world, look=True)
    for name in world.spec.channels:
        assert torch.equal(world.render(state, (name,))[name], world.render(looked, (name,))[name]), name


def test_who_is_over_stands_still_where_no_earlier_action_is_seen():
    world, rng = place(KINDS["buttons"], history=0), make_rng(1)
    state = world.start(2, rng).replace(done=torch.tensor([True, False]))
    after = world.imagine(state, torch.ones(2, 3, dtype=torch.int8), rng)
    assert after["actions"].shape == (2, 0, 3) and torch.equal(after["pose"][0], state["pose"][0])


def test_on_unknown_ground_the_walls_of_the_dream_count():
    """The rule of docs/decisions/0008: without recordings an episode has nothing but its own keyframes."""
    world = place(KINDS["buttons"])
    state = walk(world, look=False)
    _, known = world.scene.walls(state)
    assert state.deferred is not None, "among recorded keyframes nobody needs the dreamt ones"
    alone = world.without_memory()
    _, walls = alone.scene.walls(state)
    assert state.deferred is None and len(walls.shared) == 0 and walls.own.shape[1] >= known.own.shape[1]


def test_of_a_batch_those_off_known_ground_alone_are_drawn(monkeypatch):
    world, drawn, action = place(KINDS["buttons"]), [], torch.zeros(3, 3, dtype=torch.int8)
    rng = make_rng(1)
    state = world.start(3, rng)
    far = state["pose"] + torch.tensor([[0.0], [50.0], [0.0]]) * torch.eye(7)[0]
    state = world.observe({"pose": far}, state, rng)
    real = world.generator.draw
    monkeypatch.setattr(world.generator, "draw", lambda *given: (drawn.append(len(given[0])), real(*given))[1])
    after, chance_then = [state], rng.get_state()
    for _ in range(4):
        after.append(world.imagine(after[-1], action, rng))
    assert drawn == [1] * 4, "the observed frame and those after it, of the second episode"
    again = state
    rng.set_state(chance_then)
    for waited in after[1:]:
        again = world.imagine(again, action, rng)
        world.render(again, ("rgb",))
        for name, space in world.spec.channels.items():
            one, other = (world.render(each, (name,))[name].double() for each in (again, waited))
            rounding = (
                1.0 if space.dtype == np.uint8 else 1e-4
            )  # some processors sum a batch otherwise than its entries
            assert torch.allclose(one, other, rtol=1e-4, atol=rounding), name


def test_of_equally_trusted_keyframes_the_recorded_one_comes_first():
    world = place(KINDS["buttons"])
    scene, pose = world.scene, world.memory.pose[:1]
    dark, depth = torch.zeros(1, 3, *world.size, dtype=torch.uint8), torch.full((1, *world.size), 3.0)
    held = scene.own.empty(1)
    held |= scene.own.observed(held, dark, depth, pose)
    alone, both = (scene.own.look(kept, pose, 6, 3, scene.recorded) for kept in (scene.own.empty(1), held))
    assert (both.trust[:, 1] > 0).any(), "both know the view"
    assert torch.equal(both.rgb[:, 0], alone.rgb[:, 0])


def test_gradients_are_the_callers():
    """No verb forces a mode: in grad mode tensors are ordinary, in inference mode they are not."""
    world, rng = place(KINDS["buttons"], moving=True, objects=True), make_rng(0)
    with torch.inference_mode():
        inside = world.render(
            world.imagine(world.start(1, rng), world.spec.sample_action(1, rng), rng), ("rgb", "pose")
        )
    outside = world.render(world.imagine(world.start(1, rng), world.spec.sample_action(1, rng), rng), ("rgb", "pose"))
    assert inside["pose"].is_inference() and not outside["pose"].is_inference() and not outside["rgb"].is_inference()
    assert not outside["pose"].requires_grad and not world.spec.differentiable, "weights of a finished world need none"


def test_parts_are_exchanged_and_the_old_world_stays():
    world = place(KINDS["buttons"])
    asked = []
    noted = world.replaced(uncertainty=UncertaintyProbe(lambda *given: asked.append(given)), card={"more": 1})
    state = walk(noted, look=True, steps=2)
    assert len(asked) == 2 and "uncertainty" not in noted.spec.channels and noted.spec.card["more"] == 1
    judged = world.replaced(uncertainty=UncertaintyNetwork(UncertaintyConfig()), steps=3, card={"what": None})
    assert "uncertainty" in judged.spec.channels and "uncertainty" not in world.spec.channels
    assert judged.config.steps == 3 and world.config.steps == 1 and "what" not in judged.spec.card
    assert not judged.replaced(uncertainty=None).uncertainty and "more" not in world.spec.card
    assert float(judged.render(walk(judged, look=True, steps=1), ("uncertainty",))["uncertainty"].max()) > 0
    with pytest.raises(ContractError, match="has no part eye"):
        world.replaced(eye=None)
    assert state.batch == 2


@pytest.mark.parametrize("more", [{}, {"moving": True, "objects": True}], ids=["still", "things"])
def test_a_saved_world_is_the_same(tmp_path, more):
    world = place(KINDS["axes"], **more).replaced(
        uncertainty=UncertaintyNetwork(UncertaintyConfig()), card={"note": "ö"}
    )
    save_world(world, tmp_path / "one")
    first = load_world(tmp_path / "one")
    save_world(first, tmp_path / "two", remembered=tmp_path / "one")
    again = load_world(tmp_path / "two")
    assert first.spec == again.spec == world.spec and first.config == again.config == world.config
    for file in ("memory.safetensors", "world.json"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    ways = [walk(one, look=True) for one in (first, again)]
    for name in world.spec.channels:
        assert torch.equal(*(one.render(state, (name,))[name] for one, state in zip((first, again), ways))), name


def test_a_folder_keeps_other_keys_and_names_and_all_else_of_it(tmp_path):
    world = place(KINDS["choice"])
    save_world(world, tmp_path / "one")
    before = (tmp_path / "one" / "weights.safetensors").read_bytes()
    changed = replace(world.spec, keys={"KeyX": [3.0]}, action_names=("a", "b", "c", "d"), idle=(2.0,))
    save_keys(tmp_path / "one", changed)
    again = load_world(tmp_path / "one").spec
    assert again == changed and (tmp_path / "one" / "weights.safetensors").read_bytes() == before
    with pytest.raises(CheckpointError, match="no Terrella world"):
        save_keys(tmp_path, changed)


def test_channels_that_were_not_learned_are_named_in_the_card():
    world = place(KINDS["buttons"])
    about = learned.replace(world.about, ignored=("rgb.wrist", "depth.wrist"))
    told = LearnedWorld(about, **world.parts)
    assert told.spec.card["ignored channels"] == "rgb.wrist, depth.wrist"


def test_a_batch_of_many_is_one_pass_of_the_network(monkeypatch):
    """No loop over the batch: the bundled world's generator runs as often for eight episodes as for one."""
    world, calls = terrella.load("doom-maze"), []
    real = UNet.forward
    monkeypatch.setattr(
        UNet, "forward", lambda self, noisy, *rest: (calls.append(len(noisy)), real(self, noisy, *rest))[1]
    )
    walk(world, look=True, steps=1, batch=8)
    assert sum(calls) == 8 and len(calls) <= 2


@pytest.mark.parametrize(
    "more", [{}, pytest.param({"moving": True, "objects": True}, marks=pytest.mark.slow)], ids=["still", "things"]
)
def test_a_whole_step_stays_on_the_worlds_device(more):
    """`meta` stands for any second device: what it gives to the CPU, or mixes with tensors of the CPU, is an error."""
    world = place(KINDS["axes"], **more).replaced(uncertainty=UncertaintyNetwork(UncertaintyConfig())).to("meta")
    rng = make_rng(0)
    state = world.start(2, rng)
    for _ in range(2):
        state = world.imagine(state, world.spec.sample_action(2, rng).to("meta"), rng)
    shown = world.render(state, tuple(world.spec.channels))
    assert {tensor.device.type for tensor in (*shown.values(), *state.values())} == {"meta"}


def test_a_state_of_another_memory_is_adopted_or_refused():
    world = place(KINDS["buttons"])
    state, still = walk(world, look=False), torch.zeros(2, 3, dtype=torch.int8)
    twin, other = place(KINDS["buttons"]), place(KINDS["buttons"]).with_memory_budget(0.3)
    seen = world.render(state, ("rgb", "places"))
    assert all(torch.equal(value, seen[name]) for name, value in twin.render(state, tuple(seen)).items())
    after = twin.imagine(state, still, make_rng(3))
    assert after.arenas == twin.scene.own.arenas
    assert torch.equal(after["rgb"], world.imagine(state, still, make_rng(3))["rgb"])
    pose = {"pose": world.render(state, ("pose",))["pose"]}
    for verb, given in ((other.imagine, (state, still, make_rng(0))), (other.observe, (pose, state, make_rng(0))),
                        (other.render, (state, ("rgb",))), (State.stack, ([state, other.start(1, make_rng(0))],)),
                        (State.stack, ([walk(world, look=False), walk(other, look=False)],))):  # fmt: skip
        with pytest.raises(ContractError, match=r"layout|shapes"):
            list(verb(*given).values())
    with pytest.raises(ContractError, match="no memory"):
        world.render(State({"pose": torch.zeros(1, 7)}), ("rgb",))


def test_several_choices_are_each_one_hot():
    controls = Controls(CHOICE, (0.0, 2.0), (2.0, 6.0))
    world = place(controls)
    assert world.spec.action == spaces.MultiDiscrete([3, 5], start=[0, 2]) and Controls.of(world.spec) == controls
    assert controls.encode(torch.tensor([[1, 6]])).tolist() == [[0, 1, 0, 0, 0, 0, 0, 1]]
    assert check_world(world)
    cache = SimpleNamespace(world=facts_of(world.spec), action=np.zeros((4, 2), np.float32))
    assert controls_of(cache) == controls
