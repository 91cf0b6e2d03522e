"""GymnasiumWorld: a saved state goes on exactly as the environment itself would, and chance comes from the rng alone."""

from __future__ import annotations

import sys
import warnings
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

import terrella
from terrella.core import Camera, State, check_world, make_rng
from terrella.core.errors import ActionError, ObservationError, StaleStateError, TerrellaError
from terrella.core.spec import POSE, POSE_UNIT, can_idle
from terrella.sim.environment_loading import use_tracking_camera
from terrella.sim.gymnasium import Adapter, Channel, GymnasiumConfig, GymnasiumWorld

GRAPH = spaces.Sequence(spaces.Discrete(2))
COPYABLE = ("CartPole-v1", "Pendulum-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Acrobot-v1")


def plain_env(name: str, world_seed: int) -> gymnasium.Env:
    """The environment itself, reset as `start(1, make_rng(world_seed))` resets it."""
    env = gymnasium.make(name, max_episode_steps=-1)
    env.reset(seed=int(torch.randint(2**31 - 1, (1,), generator=make_rng(world_seed))))
    return env


@pytest.mark.parametrize("name", COPYABLE)
def test_a_branch_reproduces_the_environments_own_trajectory(name, tmp_path):
    """While other stories move in between, while the state is saved and loaded: every number as in the plain environment."""
    world, env = GymnasiumWorld(name, GymnasiumConfig(rgb=False)), plain_env(name, 5)
    state, rng = world.start(1, make_rng(5)), make_rng(0)
    stranger = world.start(2, rng)
    ended = False
    for step in range(60):
        action = world.spec.sample_action(1, rng)
        stranger = world.imagine(stranger, world.spec.sample_action(2, rng), rng)
        if step % 7 == 3:
            state.save(tmp_path / "state")
            state = State.load(tmp_path / "state")
        state = world.imagine(state, action, rng)
        seen, reward, terminated, _, _ = env.step(action[0].numpy())
        assert np.array_equal(state["observation"][0], seen)
        assert float(state["reward"]) == np.float32(reward) and bool(state["done"]) == terminated
        ended = ended or terminated
        if ended:
            break
    assert ended or name != "CartPole-v1"


@pytest.mark.parametrize("name", COPYABLE)
def test_a_batch_is_its_entries_side_by_side(name):
    world, rng = GymnasiumWorld(name, GymnasiumConfig(rgb=False)), make_rng(1)
    together = world.start(3, rng)
    apart = [together.at(entry) for entry in range(3)]
    for _ in range(10):
        actions = world.spec.sample_action(3, rng)
        together = world.imagine(together, actions, rng)
        apart = [world.imagine(state, actions[i : i + 1], rng) for i, state in enumerate(apart)]
    assert together == State.stack(apart)


def test_an_action_is_held_for_so_many_steps_of_the_environment():
    world, env = terrella.load("gym:CartPole-v1@3", rgb=False), plain_env("CartPole-v1", 5)
    once = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)).spec
    assert world.spec.name == "gym:CartPole-v1@3" and world.spec.dt_s == pytest.approx(3 * once.dt_s)
    assert (once.max_episode_steps, world.spec.max_episode_steps) == (500, 167)
    state, rng = world.start(1, make_rng(5)), make_rng(0)
    earned = []
    while not state["done"]:
        state, rewards, terminated = world.imagine(state, torch.tensor([1]), rng), [], False
        while len(rewards) < 3 and not terminated:
            seen, reward, terminated, _, _ = env.step(1)
            rewards.append(reward)
        assert np.array_equal(state["observation"][0], seen) and float(state["reward"]) == sum(rewards)
        assert bool(state["done"]) == terminated
        earned.append(sum(rewards))
    assert set(earned) >= {3.0}


def test_episodes_in_processes_hold_their_actions_too():
    world = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False, forkable=False, repeat=2))
    try:
        state = world.imagine(world.start(2, make_rng(0)), torch.tensor([0, 1]), make_rng(0))
        assert world.render(state, ("reward",))["reward"].tolist() == [2.0, 2.0]
    finally:
        world.close()


@pytest.mark.parametrize("count", ["0", "999"])
def test_an_action_that_is_held_for_no_or_endless_steps_is_refused(count):
    with pytest.raises(TerrellaError, match="1 to 100"):
        terrella.load(f"gym:CartPole-v1@{count}")


def test_a_state_goes_on_in_another_instance(tmp_path):
    first, second = (
        GymnasiumWorld("MountainCar-v0", GymnasiumConfig(rgb=False)),
        GymnasiumWorld("MountainCar-v0", GymnasiumConfig(rgb=False)),
    )
    action = torch.tensor([2])
    state = first.imagine(first.start(1, make_rng(0)), action, make_rng(1))
    state.save(tmp_path / "state")
    assert second.imagine(State.load(tmp_path / "state"), action, make_rng(2)) == first.imagine(
        state, action, make_rng(2)
    )


def test_dice_fall_from_the_rng_and_not_from_the_state():
    """A slippery lake: a planner may not foresee its dice, but the same rng throws them alike."""
    world = GymnasiumWorld("FrozenLake-v1", GymnasiumConfig(rgb=False))
    states = world.start(1, make_rng(0)).fork(200)
    actions = torch.full((200,), 2)
    once, again = world.imagine(states, actions, make_rng(1)), world.imagine(states, actions, make_rng(1))
    assert once == again
    places = torch.bincount(once["observation"], minlength=16)
    assert places[0] > 30 and places[1] > 30 and places[4] > 30  # up (stays), right, down: a third each
    assert world.imagine(states, actions, make_rng(2)) != once


def test_after_done_the_world_stands_still_without_reward():
    world, rng = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)), make_rng(0)
    state = world.start(2, rng)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Gymnasium warns whoever steps a finished environment
        while not state["done"].any():
            state = world.imagine(state, torch.tensor([1, 1]), rng)
        for _ in range(30):
            after = world.imagine(state, torch.tensor([0, 0]), rng)
            for entry in torch.nonzero(state["done"])[:, 0].tolist():
                was, still = state.at(entry), after.at(entry)
                assert still == was.replace(reward=torch.zeros(1))
            state = after
    assert not world.start(1, rng)["done"]


def test_the_time_limit_is_left_to_the_training():
    world, rng = GymnasiumWorld("MountainCar-v0", GymnasiumConfig(rgb=False)), make_rng(0)
    assert world.spec.max_episode_steps == 200
    state = world.start(1, rng)
    for _ in range(220):
        state = world.imagine(state, torch.tensor([1]), rng)
    assert not state["done"]
    limited = GymnasiumWorld("MountainCar-v0", GymnasiumConfig(rgb=False, options={"max_episode_steps": 3}))
    assert limited.spec.forkable
    state = limited.start(1, rng)
    dones = [bool((state := limited.imagine(state, torch.tensor([1]), rng))["done"]) for _ in range(4)]
    assert dones == [False, False, True, True]


def test_pictures_are_of_the_state_and_not_of_the_latest_step():
    pytest.importorskip("pygame", reason="drawing needs pygame: pip install 'gymnasium[classic-control]'")
    world, rng = GymnasiumWorld("CartPole-v1"), make_rng(0)
    start = world.start(1, rng)
    before = world.render(start, ("rgb",))["rgb"]
    moved = start
    for _ in range(8):
        moved = world.imagine(moved, torch.tensor([1]), rng)
    after = world.render(State.stack([moved, start]), ("rgb",))["rgb"]
    assert before.shape == (1, 400, 600, 3) and before.dtype == torch.uint8
    assert torch.equal(before[0], after[1]) and not torch.equal(after[0], after[1])
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    env.reset(seed=0)
    env.unwrapped.state = moved["observation"][0].double().numpy()
    assert (torch.from_numpy(env.render()).int() - after[0].int()).abs().float().mean() < 0.5


class Box2DLike(gymnasium.Env):
    """Keeps its state in an object, as environments with a physics engine do."""

    action_space, observation_space = spaces.Discrete(2), spaces.Box(-100, 100, (1,), np.float32)

    def __init__(self):
        self.engine = iter(())

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.engine = iter(self.np_random.normal(size=50).tolist())
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.array([next(self.engine) * (2 * action - 1)], np.float32), 1.0, False, False, {}


class Secretive(Box2DLike):
    """Looks like plain numbers, but remembers in a closure, which no snapshot sees."""

    def __init__(self):
        steps = [0]
        self.seen = 0.0
        self.count = lambda: steps.__setitem__(0, steps[0] + 1) or steps[0]

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.seen += self.count() % 7
        return np.array([self.seen % 50], np.float32), 1.0, False, False, {}


class Entangled(Box2DLike):
    """Two attributes share memory: a copy of each is not a copy of both."""

    def __init__(self):
        self.engine_state = np.zeros(2)
        self.speed = self.engine_state[1:]

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        self.engine_state[:] = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.speed += 0.1 * (2 * action - 1)
        self.engine_state[0] += self.engine_state[1]
        return self.engine_state[:1].astype(np.float32), 1.0, False, False, {}


class Collecting(Box2DLike):
    """Its state is a list that grows."""

    def __init__(self):
        self.cards = []

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        self.cards = [1]
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.cards = [*self.cards, int(action)]
        return np.array([len(self.cards)], np.float32), 1.0, len(self.cards) > 20, False, {}


@pytest.mark.parametrize("make", [Box2DLike, Secretive, Entangled, Collecting])
def test_what_cannot_be_copied_exactly_gives_tickets(make):
    world = GymnasiumWorld(make)
    assert not world.spec.forkable
    rng = make_rng(0)
    first = world.start(1, rng)
    second = world.imagine(first, torch.tensor([1]), rng)
    world.render(second, ("observation",))
    for verb in (lambda: world.imagine(first, torch.tensor([1]), rng), lambda: world.render(first, ("reward",))):
        with pytest.raises(StaleStateError, match="cannot go back"):
            verb()
    with pytest.raises(TerrellaError, match="cannot be copied"):
        GymnasiumWorld(make, GymnasiumConfig(forkable=True))


def test_what_the_trial_did_not_see_is_still_never_copied_by_halves():
    class LateBloomer(Box2DLike):
        """A number, until its hundredth step makes an object of it."""

        def __init__(self):
            self.steps = 0

        def reset(self, *, seed=None, options=None):
            gymnasium.Env.reset(self, seed=seed)
            self.steps = 0
            return np.zeros(1, np.float32), {}

        def step(self, action):
            self.steps = self.steps + 1 if self.steps < 99 else iter(())
            return np.zeros(1, np.float32), 1.0, False, False, {}

    world, rng = GymnasiumWorld(LateBloomer), make_rng(0)
    state = world.start(1, rng)
    with pytest.raises(TerrellaError, match="`steps` became .*forkable=False"):
        for _ in range(100):
            state = world.imagine(state, torch.tensor([0]), rng)


def test_a_wrapped_environment_from_a_function_is_copied_with_its_wrappers():
    def make():
        return gymnasium.wrappers.TimeAwareObservation(gymnasium.make("CartPole-v1", max_episode_steps=20))

    world, rng = GymnasiumWorld(make), make_rng(0)
    assert world.spec.forkable and world.spec.name == "gym:CartPole-v1"
    state = world.start(1, rng)
    for _ in range(3):
        state = world.imagine(state, torch.tensor([0]), rng)
    twice = world.imagine(state, torch.tensor([1]), rng), world.imagine(state, torch.tensor([1]), rng)
    assert twice[0] == twice[1]
    assert float(twice[0]["observation"][0, -1]) == float(state["observation"][0, -1]) + 1


@pytest.mark.parametrize("action", [spaces.MultiBinary(3), spaces.MultiDiscrete([2, 4]), spaces.Box(-1, 1, (2, 2))])
def test_every_kind_of_action_arrives_as_its_space_says(action):
    class Echo(gymnasium.Env):
        action_space, observation_space = action, spaces.Box(-10, 10, action.shape, np.float64)

        def __init__(self):
            self.last = np.zeros(action.shape)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.last = np.zeros(action.shape)
            return self.last.copy(), {}

        def step(self, given):
            assert given in self.action_space
            self.last = given.astype(np.float64)
            return self.last.copy(), 0.0, False, False, {}

    world, rng = GymnasiumWorld(Echo), make_rng(0)
    assert world.spec.forkable
    sampled = world.spec.sample_action(4, rng)
    seen = world.render(world.imagine(world.start(4, rng), sampled, rng), ("observation",))["observation"]
    assert torch.equal(seen, sampled.double())


def test_what_it_says_of_itself():
    spec = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)).spec
    assert (spec.dt_s, spec.name, spec.forkable, spec.max_batch) == (0.02, "gym:CartPole-v1", True, None)
    assert spec.keys["ArrowLeft"] == spec.keys["KeyA"] == [0.0] and spec.keys["ArrowRight"] == spec.keys["KeyD"] == [
        1.0
    ]
    assert spec.action_names == ("push left", "push right") and "rgb" not in spec.channels
    assert GymnasiumWorld("Pendulum-v1", GymnasiumConfig(rgb=False)).spec.dt_s == 0.05
    assert GymnasiumWorld("Pendulum-v1", GymnasiumConfig(rgb=False, dt_s=0.1)).spec.dt_s == 0.1


@pytest.mark.parametrize("extra", ["box2d", "mujoco"])
def test_packages_that_an_environment_needs_are_named_as_ours(monkeypatch, extra):
    def missing(*words, **options):
        raise gymnasium.error.DependencyNotInstalled(f'X is not installed, run `pip install "gymnasium[{extra}]"`')

    monkeypatch.setattr(gymnasium, "make", missing)
    with pytest.raises(TerrellaError, match=rf"pip install 'terrella\[{extra}\]'"):
        GymnasiumWorld("CarRacing-v3")


def test_bad_requests_are_answered_in_one_sentence():
    for name in ("NoSuchWorld-v0", "no such name", "CartPole-v99"):
        with pytest.raises(TerrellaError, match="Gymnasium cannot make"):
            GymnasiumWorld(name)
    with pytest.raises(TerrellaError, match="Gymnasium cannot make"):
        GymnasiumWorld("CartPole-v1", GymnasiumConfig(options={"no_such_option": 1}))
    with pytest.raises(TerrellaError, match="TransformObservation"):
        GymnasiumWorld(
            lambda: gymnasium.wrappers.TransformObservation(gymnasium.make("CartPole-v1"), lambda seen: (1,), GRAPH)
        )
    world, rng = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)), make_rng(0)
    state = world.start(1, rng)
    with pytest.raises(ActionError):
        world.imagine(state, torch.tensor([2]), rng)
    with pytest.raises(ObservationError):
        world.observe({"observation": torch.zeros(1, 4)}, None, rng)
    with pytest.raises(TerrellaError, match="not a state of gym:CartPole-v1"):
        world.imagine(State({"frame": torch.zeros(1)}), torch.tensor([1]), rng)


class Painter(gymnasium.Env):
    """What it observes is a picture; it steers, brakes, and counts its laps in `info`."""

    action_space = spaces.Box(np.array([-1, 0, 0], np.float32), np.ones(3, np.float32))
    observation_space = spaces.Box(0, 255, (8, 12, 3), np.uint8)

    def __init__(self):
        self.laps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.laps = 0
        return self._seen(), {"laps": 0}

    def step(self, action):
        self.laps += int(action[1] > 0.5)
        return self._seen(), 0.0, False, False, {"laps": self.laps}

    def _seen(self):
        picture = np.zeros((8, 12, 3), np.uint8)
        picture[::2, ::2] = min(255, 20 * self.laps)
        return picture


def test_a_pictured_observation_is_the_picture_made_small_and_info_gives_channels():
    world, rng = GymnasiumWorld(Painter, GymnasiumConfig(size=(4, 6), info_channels=("laps",))), make_rng(0)
    assert set(world.spec.channels) == {"rgb", "reward", "done", "laps"} and world.spec.forkable
    state = world.start(2, rng)
    gas, nothing = [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]
    for _ in range(4):
        state = world.imagine(state, torch.tensor([gas, nothing]), rng)
    seen = world.render(state, ("rgb", "laps"))
    assert seen["laps"].tolist() == [4.0, 0.0]
    assert (seen["rgb"][0] == 20).all(), "the mean of four pixels, one of them 80"
    assert (seen["rgb"][1] == 0).all() and seen["rgb"].shape == (2, 4, 6, 3)
    assert "rgb" not in GymnasiumWorld(Painter, GymnasiumConfig(rgb=False)).spec.channels


def test_arrow_keys_steer_give_gas_and_brake():
    keys = GymnasiumWorld(Painter).spec.keys
    assert keys["ArrowLeft"] == [-1, 0, 0] and keys["ArrowRight"] == [1, 0, 0]
    assert keys["ArrowUp"] == [0, 1, 0] and keys["ArrowDown"] == [0, 0, 1]


class Turntable(gymnasium.Env):
    """A camera that turns by its action, and a second one that looks the other way; an adapter names what they see."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"
    terrella = Adapter(
        channels={
            "depth": Channel(
                lambda env: np.full((8, 12), 1.0 + env.angle**2), spaces.Box(0, 9e9, (8, 12), np.float32), "m"
            ),
            "pose": Channel(lambda env: (0, 0, 0, np.cos(env.angle / 2), 0, 0, np.sin(env.angle / 2)), POSE, POSE_UNIT),
            "rgb.back": Channel(lambda env: env.picture(env.angle + np.pi), spaces.Box(0, 255, (8, 12, 3), np.uint8)),
        },
        cameras={
            "rgb": Camera((0.5, 0.75, 0.5, 0.5), (8, 12)),
            "rgb.back": Camera((0.5, 0.75, 0.5, 0.5), (8, 12), mount=(0, 0, 0, 0, 0, 0, 1)),
        },
        action_names=("turn",),
        action_units=("rad/s",),
        action_mode="velocity",
    )

    def __init__(self):
        self.angle = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle = float(self.np_random.uniform(-1, 1))
        return np.array([self.angle]), {}

    def step(self, action):
        self.angle += 0.1 * float(action[0])
        return np.array([self.angle]), 0.0, False, False, {}

    def render(self):
        return self.picture(self.angle)

    def picture(self, angle):
        return np.full((8, 12, 3), 127 + 100 * np.sin(angle), np.uint8)


def test_an_adapter_names_depth_pose_cameras_and_what_actions_mean():
    world, rng = GymnasiumWorld(Turntable), make_rng(0)
    assert {"batches", "states_can_be_saved"} <= set(check_world(world))
    spec = world.spec
    assert spec.action_units == ("rad/s",) and spec.action_mode == "velocity" and spec.units["depth"] == "m"
    assert spec.kinds("rgb") == ("rgb", "rgb.back") and spec.camera == (0.5, 0.75, 0.5, 0.5)
    state = world.start(2, rng)
    angle = state["observation"][:, 0]
    seen = world.render(state, ("depth", "pose", "rgb", "rgb.back"))
    assert torch.allclose(seen["depth"][:, 0, 0], (1 + angle**2).float()) and seen["rgb"].shape == (2, 8, 12, 3)
    assert torch.allclose(seen["pose"][:, 6], (angle / 2).sin().float())
    assert (seen["rgb"][0].int() + seen["rgb.back"][0].int() - 253).abs().max() <= 2


def test_a_channel_of_another_shape_than_it_declares_is_refused_by_name():
    wrong = Adapter(channels={"depth": Channel(lambda env: np.zeros(3), spaces.Box(0, 1, (2,), np.float32))})
    world = GymnasiumWorld(Turntable, GymnasiumConfig(adapter=wrong))
    with pytest.raises(TerrellaError, match="gave 'depth' of shape"):
        world.render(world.start(1, make_rng(0)), ("depth",))


def test_mujocos_state_is_copied_where_that_is_asked_for():
    for module in ("mujoco", "imageio"):  # Gymnasium draws MuJoCo with both
        pytest.importorskip(module, reason=f"{module} is missing: pip install 'gymnasium[mujoco]'")
    world = terrella.load("gym:Reacher-v5", rgb=False, forkable=True)
    assert "a_batch_equals_its_singles" in check_world(world, steps=6)
    assert not terrella.load("gym:Reacher-v5", rgb=False).spec.forkable  # several episodes are processes, as before
    world.close()


@pytest.mark.parametrize(
    ("cameras", "config", "drawn_by"),
    [(["side", "track"], {"distance": 4.0}, 1), (["track"], {"trackbodyid": 1}, -1), (["side"], None, -1)],
    ids=["has a camera that follows", "follows already", "has none"],
)
def test_who_runs_in_a_mujoco_environment_stays_in_the_picture(cameras, config, drawn_by):
    model = SimpleNamespace(ncam=len(cameras), camera=lambda number: SimpleNamespace(name=cameras[number]))
    renderer = SimpleNamespace(camera_id=-1, default_cam_config=config, model=model)
    use_tracking_camera(SimpleNamespace(unwrapped=SimpleNamespace(mujoco_renderer=renderer)))
    assert renderer.camera_id == drawn_by


@pytest.mark.parametrize(
    ("name", "names", "keys"),
    [
        ("CartPole-v1", ("push left", "push right"), {"ArrowLeft": 0, "KeyD": 1}),
        ("MountainCar-v0", ("push left", "no push", "push right"), {"ArrowLeft": 0, "ArrowRight": 2}),
        ("Acrobot-v1", ("torque -1", "no torque", "torque +1"), {"ArrowRight": 2}),
        ("FrozenLake-v1", ("left", "down", "right", "up"), {"ArrowDown": 1, "KeyW": 3}),
        ("Taxi-v4", ("south", "north", "east", "west", "pickup passenger", "drop off passenger"), {"Space": 4}),
    ],
)
def test_gymnasiums_own_environments_have_the_names_of_their_documentation(name, names, keys):
    spec = GymnasiumWorld(name, GymnasiumConfig(rgb=False)).spec
    assert spec.action_names == names and spec.card["how"]["action names"] == "Gymnasium's documentation"
    assert {code: spec.keys[code] for code in keys} == {code: [float(at)] for code, at in keys.items()}
    assert spec.keys.keys().isdisjoint({"KeyP", "KeyR", "KeyM"}), "those are the page's"
    assert can_idle(spec) == (name in ("MountainCar-v0", "Acrobot-v1")), "what does nothing is known"


def test_documented_names_are_for_gymnasiums_own_environments_alone():
    class Other(gymnasium.Env):
        action_space, observation_space = spaces.Discrete(2), spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            return 0, {}

    gymnasium.register("CartPole-v77", Other)
    try:
        assert GymnasiumWorld("CartPole-v77", GymnasiumConfig(rgb=False)).spec.action_names == ()
    finally:
        del gymnasium.registry["CartPole-v77"]


def test_ids_of_minigrid_need_no_module(tmp_path, monkeypatch):
    with pytest.raises(TerrellaError, match="needs the package 'minigrid', which is not installed: pip install it"):
        monkeypatch.setitem(sys.modules, "minigrid", None)
        GymnasiumWorld("BabyAI-Nowhere-v0")
    monkeypatch.delitem(sys.modules, "minigrid")
    (tmp_path / "minigrid.py").write_text(
        "import gymnasium\ngymnasium.register('BabyAI-Nowhere-v0', 'gymnasium.envs.classic_control:CartPoleEnv')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert GymnasiumWorld("BabyAI-Nowhere-v0", rgb=False).spec.name == "gym:BabyAI-Nowhere-v0"
    gymnasium.registry.pop("BabyAI-Nowhere-v0")
    del sys.modules["minigrid"]
