"""A latent world keeps the contract, is the same after a save, hands gradients on, and refuses what it cannot see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import terrella
from terrella.core import check_world, make_rng, rollout
from terrella.core.errors import ActionError, CheckpointError, ObservationError
from terrella.core.rollouts import advance
from terrella.worlds.controls import AXES, CHOICE, Controls
from terrella.worlds.folder import load_latent, load_world, save_keys, save_latent
from terrella.worlds.latent import LatentWorld
from terrella.worlds.latent_network import Ensemble, LatentConfig, LatentNetwork
from terrella.worlds.learned import About

STEERING = Controls(AXES, (-1.0, 0.0), (1.0, 4.0))
CHOICES = Controls(CHOICE, (2.0,), (5.0,))
VECTORS = (("joints", 3), ("pose", 7), ("speed", 1))
SMALL = {"latent": 8, "hidden": 24, "members": 3}


def made(controls: Controls = STEERING, **shape) -> LatentWorld:
    """Untrained, but not silent."""
    torch.manual_seed(0)
    given = {"vectors": VECTORS, "size": (32, 48), **SMALL, **shape}
    network = LatentNetwork(LatentConfig(controls.numbers, (-1.0, 0.0, 2.0), **given))
    torch.nn.init.normal_(network.predictor.leave, std=0.2)
    about = About("made", controls, 0.1, card={"what": "made for tests"})
    return LatentWorld(about, network, torch.randn(5, given["latent"]))


KINDS = {
    "pictures and vectors": {},
    "pictures alone": {"sees_vectors": False},
    "vectors alone": {"sees_pictures": False},
    "a recording without pictures": {"size": None},
    "a recording without vectors": {"vectors": ()},
    "no history": {"history": 1},
    "leaps": {"leap": 4},
    "three pictures": {"frames": 3, "glance": 6},
    "three pictures alone, and leaps": {"frames": 3, "sees_vectors": False, "leap": 4},
}


@pytest.mark.parametrize("controls", [Controls.buttons(3), CHOICES, STEERING])
@pytest.mark.parametrize("kind", KINDS)
def test_it_keeps_the_contract(kind, controls):
    world = made(controls, **KINDS[kind])
    laws = check_world(world, steps=3)
    assert "a_batch_equals_its_singles" in laws
    assert ("gradients_reach_the_action" in laws) == (controls is STEERING)


def test_what_it_sees_is_what_it_observes():
    assert made().spec.observes == ("rgb",) and made().spec.may_observe == ("joints", "speed")
    alone = made(sees_pictures=False).spec
    assert alone.observes == ("joints", "speed") and "rgb" in alone.channels and "pose" in alone.channels


def test_gradients_flow_through_a_rollout_to_every_action():
    world, rng = made(), make_rng(0)
    actions = torch.zeros(6, 4, 2).add_(0.5).requires_grad_()
    seen = rollout(world, world.start(4, rng), actions, rng, ("joints", "reward"), gradients=True).observations
    (seen["joints"][-1].square().sum() + seen["reward"].sum()).backward()
    assert actions.grad is not None and torch.isfinite(actions.grad).all()
    assert (actions.grad.flatten(1).abs().sum(1) > 0).all()


def test_the_ensemble_at_once_is_its_members_one_by_one():
    torch.manual_seed(0)
    both = [Ensemble(4, 10, 16, 6).double() for _ in range(2)]
    both[1].load_state_dict(both[0].state_dict())
    x = torch.randn(7, 10, dtype=torch.float64)
    fast, slow = both[0](x), both[1].slowly(x)
    assert torch.allclose(fast, slow)
    fast.square().sum().backward()
    slow.square().sum().backward()
    for one, other in zip(both[0].parameters(), both[1].parameters()):
        assert one.grad is not None and other.grad is not None and torch.allclose(one.grad, other.grad)


def test_it_is_the_same_after_a_save_to_the_last_byte(tmp_path):
    world = made()
    save_latent(world, tmp_path / "one")
    again = load_latent(tmp_path / "one")
    save_latent(again, tmp_path / "two")
    for name in ("world.json", "weights.safetensors", "memory.safetensors", "README.md"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name
    assert repr(again.spec) == repr(world.spec)
    seen = []
    for one in (world, again):
        rng = make_rng(3)
        state = one.start(3, rng)
        for _ in range(4):
            state = one.imagine(state, one.spec.sample_action(3, rng), rng)
        seen.append(one.render(state, tuple(one.spec.channels)))
    assert all(torch.equal(seen[0][name], seen[1][name]) for name in seen[0])


def test_it_is_opened_by_its_folder_and_keeps_other_keys(tmp_path):
    save_latent(made(CHOICES), tmp_path)
    world = terrella.load(tmp_path)
    assert isinstance(world, LatentWorld)
    save_keys(tmp_path, replace(world.spec, keys={"KeyA": [3.0]}))
    assert terrella.load(tmp_path).spec.keys == {"KeyA": [3.0]}
    with pytest.raises(CheckpointError, match="latent world"):
        load_world(tmp_path)
    with pytest.raises(CheckpointError, match="memory_mb"):
        terrella.load(tmp_path, memory_mb=4.0)
    with pytest.raises(CheckpointError, match="latent world"):
        terrella.load(tmp_path, fast=True)
    (tmp_path / "weights.safetensors").write_bytes(b"no weights")
    with pytest.raises(CheckpointError, match="damaged"):
        terrella.load(tmp_path)


def test_what_it_cannot_see_is_refused():
    world, rng = made(), make_rng(0)
    seen = dict(world.render(world.start(2, rng), ("rgb", "joints", "speed")))
    state = world.observe(seen, None, rng)
    for name, wrong in {
        "rgb": torch.zeros(2, 32, 32, 3, dtype=torch.uint8),
        "joints": torch.zeros(2, 4),
        "speed": torch.tensor([[float("nan")], [0.0]]),
    }.items():
        with pytest.raises(ObservationError, match=name):
            world.observe({**seen, name: wrong}, None, rng)
    with pytest.raises(ObservationError, match="batch"):
        world.observe({**seen, "joints": torch.zeros(3, 3)}, None, rng)
    with pytest.raises(ObservationError, match="prior"):
        world.observe(seen, state.at(0), rng)
    with pytest.raises(ActionError):
        world.imagine(state, torch.full((2, 2), float("nan")), rng)


def test_vectors_beside_a_picture_count_only_where_they_are_given():
    world, rng = made(), make_rng(0)
    seen = dict(world.render(world.start(1, rng), ("rgb", "joints", "speed")))
    bare = world.observe({"rgb": seen["rgb"]}, None, rng)["window"]
    known = world.observe(seen, None, rng)["window"]
    other = world.observe({**seen, "joints": seen["joints"] + 3}, None, rng)["window"]
    assert not torch.equal(bare, known) and not torch.equal(known, other)


def test_what_is_over_stands_still_and_pays_nothing():
    world, rng = made(), make_rng(0)
    state = world.start(2, rng)
    state = state.replace(done=torch.tensor([True, False]))
    after = world.imagine(state, world.spec.sample_action(2, rng), rng)
    assert torch.equal(after["window"][0], state["window"][0]) and float(after["reward"][0]) == 0
    assert not torch.equal(after["window"][1], state["window"][1]) and bool(after["done"][0])


@pytest.mark.parametrize("history", [1, 3])
def test_a_leap_is_of_its_own_episode_keeps_the_last_actions_and_leaves_what_is_over(history):
    world, rng = made(leap=2, history=history), make_rng(0)
    torch.nn.init.normal_(world.network.leaper.leave, std=0.2)
    state, actions = world.start(3, rng), torch.rand(3, 2, 2)
    state = state.replace(done=torch.tensor([False, False, True]))
    after = world.leap(state, actions, rng)
    for entry in range(2):
        alone = world.leap(state.at(entry), actions[entry : entry + 1], rng)
        for name in after:
            assert torch.allclose(after[name][entry : entry + 1], alone[name], atol=1e-5), name
    assert torch.equal(after["window"][2], state["window"][2]) and (after["window"][0] != state["window"][0]).any()
    kept = world.controls.encode(actions[0])[2 - min(2, history - 1) :]
    assert torch.allclose(after["actions"][0, -len(kept) :] if len(kept) else kept, kept)
    whole = advance(world, state, torch.cat([actions, actions, actions[:, :1]], 1), rng)
    slow = world.imagine(world.leap(after, actions, rng), actions[:, 0], rng)
    assert torch.equal(whole["window"], slow["window"])


def test_a_thousand_episodes_are_no_loop_and_a_state_is_small():
    world, rng = made(), make_rng(0)
    state = world.start(1024, rng)
    state = world.imagine(state, world.spec.sample_action(1024, rng), rng)
    assert state.nbytes < 1024 * 1024
    assert np.isfinite(world.render(state, ("latent",))["latent"].numpy()).all()


def test_latents_stay_within_bounds_however_long_it_goes_on():
    world, rng = made(), make_rng(0)
    state = world.start(2, rng)
    for _ in range(60):
        state = world.imagine(state, world.spec.sample_action(2, rng), rng)
    assert world.spec.channels["latent"].contains(state["window"][0, -1].numpy())


def test_one_number_is_shown_as_the_game_shows_it_and_a_state_of_one_stays_a_list():
    world = made(vectors=(("health", 1), ("observation", 1)), size=None)
    shown = world.render(world.start(3, make_rng(0)), ("health", "observation"))
    assert shown["health"].shape == (3,) and shown["observation"].shape == (3, 1)
    assert world.spec.channels["health"].shape == () and world.spec.channels["observation"].shape == (1,)
    again = world.observe(shown, None, make_rng(0))
    assert world.render(again, ("health",))["health"].shape == (3,)


def test_a_spread_beyond_all_that_was_seen_tells_of_a_larger_error():
    network = made().network
    network.spread.copy_(torch.linspace(0, 4, len(network.spread)))
    network.error.copy_(torch.linspace(0, 0.2, len(network.error)))
    found = network.expected(torch.tensor([0.0, 2.0, 4.0, 8.0, 12.0, 100.0]))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.1, 0.2, 0.4, 0.6, 1.0]))


def test_uncertainty_rises_with_the_spread_and_is_none_of_what_was_seen():
    world, rng = made(), make_rng(0)
    network = world.network
    network.spread.copy_(torch.linspace(0, 4, len(network.spread)))
    network.error.copy_(torch.linspace(0, 1, len(network.error)).square())
    state = world.start(1, rng)
    levels = [float(world.render(state, ("uncertainty",))["uncertainty"])]
    for _ in range(5):
        state = world.imagine(state, world.spec.sample_action(1, rng), rng)
        levels.append(float(world.render(state, ("uncertainty",))["uncertainty"]))
    assert levels[0] == 0 and levels == sorted(levels) and 0 < levels[-1] <= 1


@pytest.mark.parametrize(("before", "counts"), [(1, True), (2, True), (3, False)])
def test_a_latent_is_made_of_the_pictures_of_the_last_three_steps(before, counts):
    world, rng = made(frames=3, sees_vectors=False), make_rng(0)
    pictures = torch.randint(0, 255, (3, 32, 48, 3), dtype=torch.uint8, generator=rng)
    state = world.observe({"rgb": pictures[:2]}, None, rng)
    for _ in range(before):
        state = world.imagine(state, world.spec.sample_action(2, make_rng(1))[:1].expand(2, -1), rng)
        state = state.replace(done=torch.zeros(2, dtype=torch.bool))
    after = world.observe({"rgb": pictures[2:].expand(2, -1, -1, -1)}, state, rng)["window"][:, -1]
    assert torch.allclose(after[0], after[1], atol=1e-5) != counts
    assert torch.equal(after, world.observe({"rgb": pictures[2:].expand(2, -1, -1, -1)}, state, rng)["window"][:, -1])
