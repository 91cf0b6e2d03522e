"""Randomised worlds: draws are seeded, within their limits, shown, and safe; actions come late; noise is seen and not true."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import Spec, State, check_world, make_rng
from terrella.core.errors import TerrellaError
from terrella.library import load
from terrella.sim.randomised import Distribution, Randomised, read

FILE = """
"noise.qpos" = {constant = 0.05}
delay = {choice = [0, 2]}
friction = {uniform = [0.4, 1.25]}
[mass]
torso = {loguniform = [0.5, 2.0]}
"""

needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")


@pytest.fixture
def file(tmp_path):
    (tmp_path / "x.toml").write_text(FILE)
    return tmp_path / "x.toml"


def test_draws_lie_within_their_limits_and_follow_their_kind():
    seeds = torch.arange(4000)
    for kind, numbers, mean in (
        ("uniform", (2, 4), 3),
        ("loguniform", (1, 100), 99 / 4.605),
        ("normal", (5, 1), 5),
        ("choice", (0, 1, 5), 2),
        ("constant", (7,), 7),
    ):
        one = Distribution(kind, tuple(map(float, numbers)))
        drawn = one.draw(seeds, 3)
        assert drawn.min() >= one.limits[0] and drawn.max() <= one.limits[1]
        assert drawn.mean() == pytest.approx(mean, rel=0.06)


@needs_mujoco
def test_each_episode_draws_and_shows_what_it_drew(file):
    world = load("mujoco:ant", randomise=file)
    assert list(world.spec.card["randomised"]) == ["noise.qpos", "delay", "friction", "mass.torso"]
    one, same = (world.start(32, make_rng(5)) for _ in range(2))
    drawn = world.render(one, ("parameters",))["parameters"]
    assert torch.equal(drawn, world.render(same, ("parameters",))["parameters"])
    assert len(drawn[:, 2].unique()) == 32 and set(drawn[:, 1].tolist()) == {0, 2}
    after = world.imagine(one, torch.zeros(32, 8), make_rng(0))
    assert torch.equal(world.render(after, ("parameters",))["parameters"], drawn)  # of the episode, not of the step
    assert torch.allclose(one["parameters"].float(), drawn[:, 2:])
    seen, true = world.render(after, ("qpos",))["qpos"], world.world.render(after, ("qpos",))["qpos"]
    assert (seen - true).std() == pytest.approx(0.05, rel=0.2)


@needs_mujoco
def test_the_contract_holds_around_mujoco(tmp_path):
    (tmp_path / "x.json").write_text('{"gravity": {"uniform": [5, 10]}, "delay": 1, "noise.qvel": 0.1}')
    assert "a_batch_equals_its_singles" in check_world(
        load("mujoco:ant", randomise=tmp_path / "x.json", cameras=()), steps=4
    )


def test_actions_come_late_in_any_world():
    plain = load("gym:Pendulum-v1", rgb=False)
    late = Randomised(plain, {"delay": Distribution("constant", (2.0,))})
    state, true = late.start(1, make_rng(0)), None
    actions = [torch.tensor([[value]]) for value in (2.0, -2.0, 1.0)]
    for action in actions:
        state = late.imagine(state, action, make_rng(1))
    true = plain.start(1, make_rng(0))
    for action in (torch.zeros(1, 1), torch.zeros(1, 1), actions[0]):
        true = plain.imagine(true, action, make_rng(1))
    assert torch.equal(
        late.render(state, ("observation",))["observation"], plain.render(true, ("observation",))["observation"]
    )


UNSOUND = {
    "friction = {uniform = [0.0, 9.0]}": "cannot be randomised safely from 0 to 9.*within 0.05 to 3",
    "frictoin = {uniform = [0.4, 1]}": "no parameter 'frictoin'; did you mean 'friction'",
    "mass = {uniform = [1.2, 0.8]}": "lower number first",
    "mass = {even = [1, 2]}": "is one of uniform",
    "mass = {uniform = [1]}": "takes 2 numbers",
    "delay = {uniform = [0, 3]}": "whole steps",
    "textures = 2": "cannot be randomised safely from 2 to 2.*within 0 to 1",
    '"camera.roll" = 3': "within -0.5 to 0.5 rad",
    '"noise.done" = 0.1': "a float channel",
    "mass": "not TOML",
    "": "has no distribution",
}


@needs_mujoco
@pytest.mark.parametrize("text", UNSOUND)
def test_what_cannot_be_is_said(text, tmp_path):
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(TerrellaError, match=UNSOUND[text]):
        load("mujoco:ant", randomise=tmp_path / "x.toml")


def test_files_are_read(file):
    found = read(file)
    assert found["mass.torso"] == Distribution("loguniform", (0.5, 2.0)) and found["noise.qpos"].kind == "constant"
    file.write_text("mass.torso = 1.2")
    assert read(file) == {"mass.torso": Distribution("constant", (1.2,))}


class Slider:
    """A world that is as far along as its last action says."""

    spec = Spec(
        name="slider",
        action=spaces.Box(-1, 1, (1,), np.float32),
        channels={"at": spaces.Box(-1, 1, (1,), np.float32)},
        observes=(),
        dt_s=0.1,
    )

    def start(self, batch, rng):
        return State({"at": torch.zeros(batch, 1)})

    def observe(self, observation, prior, rng):
        return prior or self.start(1, rng)

    def imagine(self, state, action, rng):
        return State({"at": self.spec.check_action(action, state.batch)})

    def render(self, state, channels):
        return {name: state[name] for name in channels}


def test_backlash_follows_only_when_its_play_is_used_up():
    world, rng = Randomised(Slider(), {"backlash": Distribution("constant", (0.4,))}), make_rng(0)
    state, seen = world.start(1, rng), []
    for asked in (0.1, 0.5, 0.4, 0.2, -0.2):
        state = world.imagine(state, torch.tensor([[asked]]), rng)
        seen.append(round(float(world.render(state, ("at",))["at"]), 4))
    assert seen == [0.0, 0.3, 0.3, 0.3, 0.0]
    with pytest.raises(TerrellaError, match="axes"):
        Randomised(load("gym:CartPole-v1", forkable=True, rgb=False), {"backlash": Distribution("constant", (0.1,))})


@needs_mujoco
def test_the_scale_goes_from_the_nominal_world_to_the_whole_range():
    told = {"gravity": Distribution("constant", (4.81,)), "delay": Distribution("constant", (4.0,))}
    world = Randomised(load("mujoco:arm", cameras=()), told)
    for scale, drawn in ((0.0, (9.81, 0.0)), (0.5, (7.31, 2.0)), (1.0, (4.81, 4.0))):
        world.scale = scale
        found = world.render(world.start(2, make_rng(0)), ("parameters",))["parameters"]
        assert torch.allclose(found, torch.tensor(drawn).expand(2, 2), atol=1e-5)
    told["backlash"] = Distribution("constant", (0.1,))
    check_world(Randomised(load("mujoco:arm", cameras=()), told))
    with pytest.raises(TerrellaError, match="from 0 to 1"):
        Randomised(load("mujoco:arm", cameras=()), told, scale=2.0)


@needs_mujoco
def test_at_a_scale_of_nothing_every_parameter_leaves_the_world_as_it_is():
    plain = load("mujoco:ant", cameras=())
    told = {name: Distribution("uniform", (one.low, one.high)) for name, one in plain.parameters.items()}
    same = Randomised(plain, told, scale=0.0)
    after = [world.start(1, make_rng(0)) for world in (plain, same)]
    push = torch.full((1, 8), 0.5)
    for _ in range(20):
        after = [world.imagine(state, push, make_rng(1)) for world, state in zip((plain, same), after)]
    assert torch.allclose(after[0]["physics"], after[1]["physics"], atol=1e-9)
    assert same.spec.cameras == {}  # lenses differ, so none is told


@needs_mujoco
def test_models_are_made_once_though_worlds_are_looked_at_one_by_one(monkeypatch):
    from terrella.sim.mujoco_parameters import Models

    made, change = [], Models.changed
    monkeypatch.setattr(Models, "changed", lambda self, *rest: made.append(1) or change(self, *rest))
    world, rng = Randomised(load("mujoco:ant", cameras=()), {"mass": Distribution("uniform", (0.9, 1.1))}), make_rng(0)
    state = world.start(100, rng)
    for _ in range(2):
        state = world.imagine(state, world.spec.sample_action(100, rng), rng)
        world.render(state, ("contacts",))
    assert len(made) <= 101  # the file's own, at the start, and one of each world


def test_masses_multiply_in_any_order():
    from terrella.sim.mujoco_parameters import Models

    world = load("mujoco:ant", cameras=())
    names = ("mass.torso", "mass", "inertia")
    at, found = world.file.body("torso").id, []
    for order in (names, names[::-1]):
        model = Models(world.file, [world.parameters[name] for name in order]).of(
            np.array([[{"mass.torso": 3.0, "mass": 2.0, "inertia": 0.5}[name] for name in order]])
        )[0]
        found.append(
            (model.body_mass[at] / world.file.body_mass[at], model.body_inertia[at] / world.file.body_inertia[at])
        )
    assert found[0][0] == pytest.approx(6.0) and found[1][0] == pytest.approx(6.0)
    assert found[0][1] == pytest.approx(3.0) and found[1][1] == pytest.approx(3.0)


@needs_mujoco
def test_parameters_that_would_do_nothing_are_not_offered():
    assert "strength" not in load("mujoco:ant", cameras=()).parameters  # no actuator of its is limited


@pytest.mark.slow
@needs_mujoco
def test_looks_differ_by_world_and_change_nothing_else(tmp_path):
    """Each alone: drawn again the same, at nothing as in the file, bodies where they were."""
    plain = load("mujoco:ant", size=(24, 32), segmentation=True)
    start = plain.start(3, make_rng(2))
    try:
        nominal = plain.render(start, ("rgb", "segmentation", "pose"))
    except TerrellaError as error:
        pytest.skip(str(error))
    looks = {
        "textures": (0.9, 1.0),
        "colours": (0.9, 1.0),
        "light.tilt": (0.5, 0.8),
        "camera.roll": (0.2, 0.5),
    }
    for name, limits in looks.items():
        told = {name: Distribution("uniform", limits)}
        world = Randomised(plain, told)
        state = world.start(3, make_rng(2))
        seen = world.render(state, ("rgb", "segmentation", "pose"))
        changed = (seen["rgb"].int() - nominal["rgb"].int()).abs().amax(-1) > 8
        assert changed.flatten(1).any(1).all(), name
        assert torch.equal(world.render(state, ("rgb",))["rgb"], seen["rgb"])
        assert torch.equal(state["physics"], start["physics"])
        if not name.startswith("camera"):
            assert torch.equal(seen["segmentation"], nominal["segmentation"])
            assert torch.equal(seen["pose"], nominal["pose"])
        else:
            moved = seen["pose"] - nominal["pose"]
            assert moved[:, :3].abs().max() < 1e-6 and moved[:, 3:].abs().max() > 0.05
        none = Randomised(plain, told, scale=0.0)
        assert torch.equal(none.render(none.start(3, make_rng(2)), ("rgb",))["rgb"], nominal["rgb"])


@needs_mujoco
def test_what_is_seen_goes_together_in_any_order():
    """Turns of a camera and shifts of colours: the same picture whichever the file declares first."""
    told = {
        "camera.yaw": 0.3,
        "red": 0.2,
        "light.tilt": 0.5,
        "light.turn": 2.0,
        "camera.roll": 0.4,
        "colours": 0.5,
        "textures": 0.8,
    }
    declared = [(name, Distribution("constant", (value,))) for name, value in told.items()]
    shown = []
    for order in (declared, declared[::-1]):
        world = Randomised(load("mujoco:ant", size=(24, 32)), dict(order))
        try:
            shown.append(world.render(world.start(1, make_rng(2)), ("rgb",))["rgb"])
        except TerrellaError as error:
            pytest.skip(str(error))
    assert torch.equal(*shown)


@needs_mujoco
def test_patterns_tile_and_differ():
    from terrella.sim.mujoco_appearance import PATTERNS, pattern

    rng = np.random.default_rng(0)
    made = [pattern(at, rng).astype(int) for at in range(PATTERNS)]
    for at, one in enumerate(made):
        assert all(np.abs(one - other).mean() > 10 for other in made[:at])
        if at % 4 == 3:  # clouds: no seam where the last row meets the first
            assert np.abs(one[0] - one[-1]).max() <= 2 * np.abs(np.diff(one, axis=0)).max()
