"""MuJoCo on a device: states, actions, rewards and resets stay there; what cannot is refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from terrella import load, make_rng
from terrella.core.dispatch import Dispatches
from terrella.core.errors import TerrellaError
from terrella.core.state import State
from terrella.learn.imagination import ContinuedEpisodes
from terrella.learn.train_step import TrainStep
from terrella.sim import mujoco_world
from terrella.sim.mujoco_stepping import Stepper
from terrella.sim.mujoco_warp import ON_CPU

ROBOTS = ("ant", "arm", "hopper", "reacher")


class Single(Stepper):
    """Steps in float64, and speaks float32, as mujoco-warp does."""

    def __init__(self, file, device):
        super().__init__(file, {}, 1)

    def step(self, physics, warmstart, ctrl, values, steps):
        assert {part.dtype for part in (physics, warmstart, ctrl)} == {torch.float32}
        if physics.is_meta:
            return physics.clone(), physics.new_zeros(len(physics), self.file.nsensordata), warmstart.clone()
        made = super().step(physics.double(), warmstart.double(), ctrl.double(), values, steps)
        return tuple(part.float() for part in made)


@pytest.fixture
def single(monkeypatch):
    monkeypatch.setattr(mujoco_world, "WarpStepper", Single)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_step_and_a_reset_stay_on_the_device(single, name):
    here, there = (load(f"mujoco:{name}", cameras=(), device=device) for device in ("", "meta"))
    wanted, now = (
        here.start(2, make_rng(0)),
        TrainStep(0, 0.0, torch.device("meta"), np.random.default_rng(0), make_rng(0)),
    )
    episodes = ContinuedEpisodes(there, 2, 50, 0)
    episodes.begin(now)  # makes the constants
    there.imagine(there.start(2, now.seeding), there.spec.sample_action(2, now.seeding), now.seeding)
    with Dispatches("meta") as counts:
        state = episodes.begin(now)
        state = there.imagine(state, there.spec.sample_action(2, now.seeding), now.seeding)
        shown = there.render(state, [name for name in there.spec.channels if name != "contacts"])
        episodes.end(state, 1, now)
    assert counts.waits == 0 and counts.crossings <= 3, "the seeds of the reset, and the action"
    assert all(part.is_meta for part in (*state.values(), *shown.values()))
    assert {part: value.shape for part, value in state.items()} == {part: value.shape for part, value in wanted.items()}


@pytest.mark.parametrize("name", ROBOTS)
def test_in_float32_a_robot_moves_as_in_float64(single, name):
    compare(name, 10, 2e-3)


@pytest.mark.parametrize("device", [ON_CPU, "cuda"])
@pytest.mark.parametrize("name", [*ROBOTS, "go1", "g1"])
def test_mujoco_warp_steps_as_mujoco_does(name, device):
    pytest.importorskip("mujoco_warp", reason="mujoco-warp is not installed")
    try:
        compare(name, 4, 5e-3, device)
    except TerrellaError as error:
        pytest.skip(str(error))


def compare(name: str, steps: int, close: float, device: str = ON_CPU) -> None:
    """Both ways for some steps with small actions, one world of three over from the start."""
    slow, fast = (load(f"mujoco:{name}", cameras=(), device=device) for device in ("", device))
    mine, single = (world.start(3, make_rng(1)) for world in (slow, fast))
    over = torch.tensor([False, True, False])
    mine, single = (state.replace(done=over.to(state.device)) for state in (mine, single))
    before = State({part: value.clone() for part, value in single.items()})
    for step in range(steps):
        action = torch.lerp(torch.tensor(slow.spec.idle).expand(3, -1), slow.spec.sample_action(3, make_rng(step)), 0.2)
        mine, single = slow.imagine(mine, action, make_rng(0)), fast.imagine(single, action, make_rng(0))
    shown = [part for part in slow.spec.channels if part != "contacts"]
    for part, value in slow.render(mine, shown).items():
        torch.testing.assert_close(fast.render(single, shown)[part].cpu(), value, atol=close, rtol=close)
    assert single["physics"].dtype == torch.float32 and torch.equal(single["physics"][1], before["physics"][1])
    assert single["reward"][1] == 0


def test_a_world_that_becomes_unstable_on_a_device_ends_and_keeps_its_state(single):
    world = load("mujoco:hopper", cameras=(), device=ON_CPU)
    state = world.start(2, make_rng(0))
    broken = state.replace(physics=state["physics"].index_fill(0, torch.tensor([1]), torch.nan))
    after = world.imagine(broken, world.spec.sample_action(2, make_rng(0)), make_rng(0))
    assert after["done"].tolist() == [False, True] and after["physics"][0].isfinite().all()


def test_what_needs_the_cpu_is_refused_by_name(single):
    for name, options, lack in (
        ("drone", {}, "the autopilot of mujoco:drone needs the CPU; leave device out"),
        ("car:road", {}, "the task Driving"),
        ("hopper", {"parameters": ("gravity",)}, "physics that differs between worlds"),
        ("hopper", {"device": "nonsense"}, "PyTorch has no device 'nonsense' here; give cuda or cuda:1"),
        ("hopper", {"device": "cuda:99"}, "PyTorch has no device 'cuda:99' here"),
    ):
        with pytest.raises(TerrellaError, match=lack):
            load(f"mujoco:{name}", **{"device": ON_CPU, "cameras": (), **options})
