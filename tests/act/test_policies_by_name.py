"""Policies by name: each does what its name says, slips as often as it is told to, and what is no policy is one sentence."""

from __future__ import annotations

import pytest
import torch
from tests.act.tiny_worlds import Grid, Point

import terrella
from terrella.act.actor import Actor
from terrella.act.actor_network import ActorConfig, ActorNetwork
from terrella.act.planning import Planner
from terrella.core.errors import TerrellaError
from terrella.core.policy import Reactive, act, observed_channels
from terrella.core.world import make_rng

CONTROLLERS = """
import torch

def homing(observation, rng):
    return (-observation["observation"]).clamp(-1, 1)

def made(spec):
    return homing

class Lazy:
    sees = ("observation",)
    def begin(self, batch, rng): return None
    def act(self, observation, memory, rng): return torch.zeros(len(observation["observation"]), 2), memory

lazy = Lazy()
number = 3
def broken(spec): raise ValueError("no such gain")
"""


def done_by(name, world=None, batch=400, plans_in=None):
    world = world or Point()
    policy = terrella.load_policy(name, world.spec, plans_in)
    seen, rng = world.render(world.start(batch, make_rng(0)), ("observation",)), make_rng(1)
    action, _ = act(policy, seen, policy.begin(batch, rng), batch, world.spec, rng)
    return world.spec.check_action(action, batch)


@pytest.fixture
def controllers(tmp_path):
    (tmp_path / "controllers.py").write_text(CONTROLLERS)
    return tmp_path / "controllers.py"


def test_each_does_what_its_name_says(controllers):
    assert not done_by("idle").any()
    assert (done_by("constant:0.5,-1") == torch.tensor([0.5, -1])).all()
    assert (done_by("constant:2", Grid()) == 2).all()
    assert done_by("random").std() > 0.5 and len(done_by("explorer", batch=2)) == 2
    home = done_by(f"{controllers}:homing")
    assert torch.equal(home, done_by(f"{controllers}:made")) and home.abs().max() == 1
    assert not done_by(f"{controllers}:lazy").any() and not done_by(f"{controllers}:Lazy").any()
    assert isinstance(terrella.load_policy(f"{controllers}:homing", Point().spec), Reactive)


def test_a_choice_has_a_name():
    world = Grid(action_names=("stay", "right", "left", "down", "up"))
    assert (done_by("constant:Down", world) == 3).all()


def test_it_plans_with_settings():
    world = Point()
    planner = terrella.load_policy("plan:samples=8,horizon=3,search=cem,replan=2,trust=0.5", world.spec, world)
    assert isinstance(planner, Planner) and planner.sees == world.spec.observes
    assert (planner.config.search, planner.config.samples, planner.config.horizon) == ("cem", 8, 3)
    assert done_by("plan:samples=8,iterations=1", batch=4, plans_in=world).shape == (4, 2)


def test_a_learned_policy_is_opened_by_its_folder(tmp_path):
    spec = Point().spec
    network = ActorNetwork(ActorConfig.of(spec, ("observation",), 8))
    Actor(network, spec).save(tmp_path / "learned")
    policy = terrella.load_policy(tmp_path / "learned", spec)
    assert isinstance(policy, Actor) and policy.sees == ("observation",)
    assert done_by(f"{tmp_path / 'learned'}@0.5").shape == (400, 2)
    with pytest.raises(TerrellaError, match="Grid"):
        terrella.load_policy(tmp_path / "learned", Grid().spec)


def test_what_need_not_be_seen_may_be_missing():
    world = Point(may_observe=("health",))
    planner = terrella.load_policy("plan", world.spec, world)
    assert planner.sees == ("observation", "health") and observed_channels(planner, world.spec) == ("observation",)
    assert observed_channels(terrella.load_policy("explorer", world.spec), world.spec) == tuple(world.spec.channels)


def test_a_policy_slips_as_often_as_it_is_told():
    for share in (0.0, 0.3, 1.0):
        slips = (done_by(f"idle@{share}", batch=4000) != 0).any(1).float().mean()
        assert abs(slips - share) < 0.05


@pytest.mark.parametrize(
    "name, said",
    [
        ("rondom", "did you mean 'random'.*There are: random, idle"),
        ("random:3", "takes no settings"),
        ("idle@2", "probability of 0 to 1"),
        ("idle@often", "probability of 0 to 1"),
        ("constant:1", "give 2 numbers"),
        ("constant:left", "give 2 numbers"),
        ("constant:9,9", "takes actions in"),
        ("plan", "needs a world to plan in"),
        ("plan:sample=3", "did you mean 'samples'"),
        ("plan:samples=many", "whole number"),
        ("plan:search=luck", "no search 'luck'"),
        ("no_such_module:policy", "no Python module 'no_such_module'"),
        ("nowhere.py:policy", "no file nowhere.py"),
        ("{own}:homin", "did you mean 'homing'"),
        ("{own}:number", "is not a policy"),
        ("{own}:broken", "ValueError: no such gain"),
        ("{folder}", "holds no policy"),
    ],
)
def test_what_is_no_policy_is_said_in_a_sentence(controllers, name, said):
    world = Point()
    given = name.format(own=controllers, folder=controllers.parent)
    with pytest.raises(TerrellaError, match=said):
        terrella.load_policy(given, world.spec, None if name == "plan" else world)
