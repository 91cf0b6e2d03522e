"""as_env: what Gymnasium asks of a vector environment, over worlds of both kinds."""

from __future__ import annotations

import math
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.passive_env_checker import check_action_space, check_observation_space
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers

import terrella
from terrella.core import Spec, State, WorldEnv, as_env, check_world, make_rng
from terrella.core.errors import ActionError, ChannelError, TerrellaError
from terrella.core.policy import Random
from terrella.data import record
from terrella.sim.gymnasium import GymnasiumConfig, GymnasiumWorld
from terrella.sim.replay import ReplayWorld

FRAMES = 5


@pytest.fixture(scope="module")
def cartpole():
    return GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False))


@pytest.fixture
def film():
    """Five frames whose observation is their number; rewards 1 to 4; done at the end."""
    frames = np.arange(FRAMES, dtype=np.float32)
    channels = {
        "observation": frames[:, None],
        "reward": frames,
        "rgb": np.zeros((FRAMES, 4, 6, 3), np.uint8) + frames.astype(np.uint8)[:, None, None, None],
    }
    given = {"observation": spaces.Box(0, FRAMES, (1,), np.float32)}
    return ReplayWorld(channels, np.zeros(FRAMES - 1), spaces.Discrete(2), 0.1, spaces_given=given)


class SingleView(gymnasium.Env):
    """One environment of a WorldEnv, as Gymnasium's own checker wants to see it."""

    def __init__(self, env: WorldEnv):
        self.inner, self.render_mode, self.metadata = env, env.render_mode, env.metadata
        self.observation_space, self.action_space = env.single_observation_space, env.single_action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        observations, infos = self.inner.reset(seed=seed, options=options)
        return self._first(observations), infos

    def step(self, action):
        observations, rewards, terminated, truncated, infos = self.inner.step(np.asarray(action)[None])
        return self._first(observations), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), infos

    def render(self):
        return self.inner.render()[0]

    def _first(self, observations):
        if isinstance(observations, dict):
            return {name: np.asarray(array[0]) for name, array in observations.items()}
        return observations[0]


@pytest.mark.parametrize("observation", ["observation", ("observation", "done")])
@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
def test_gymnasiums_own_checker_passes(name, observation):
    env = SingleView(as_env(GymnasiumWorld(name), observation=observation, max_steps=50))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(infinity|symmetric and normalized|alternative render modes).*")
        check_env(env)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_spaces_arrays_and_metadata_agree(cartpole, mode):
    env = as_env(cartpole, num_envs=3, max_steps=30, observation=("observation", "reward"), autoreset_mode=mode)
    assert env.metadata["autoreset_mode"] is mode and env.num_envs == 3
    for space in (env.observation_space, env.single_observation_space):
        check_observation_space(space)
    for space in (env.action_space, env.single_action_space):
        check_action_space(space)
    env.action_space.seed(0)
    observations, infos = env.reset(seed=0)
    assert observations in env.observation_space and infos == {}
    for _ in range(60):
        observations, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
        assert observations in env.observation_space and isinstance(infos, dict)
        assert rewards.shape == terminated.shape == truncated.shape == (3,)
        assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
        ended = terminated | truncated
        if mode is AutoresetMode.DISABLED and ended.any():
            env.reset(options={"reset_mask": ended})
    env.close()
    assert env.closed


def test_the_seed_tells_the_story(cartpole):
    def story(env, seed):
        frames = [env.reset(seed=seed)[0]]
        actions = np.random.default_rng(1)
        return np.stack(frames + [env.step(actions.integers(0, 2, 2))[0] for _ in range(60)])

    env = as_env(cartpole, num_envs=2, seed=5)
    first = story(env, 5)
    assert np.array_equal(first, story(env, 5)) and not np.array_equal(first, story(env, 6))
    assert np.array_equal(first[0], as_env(cartpole, num_envs=2, seed=5).reset()[0])
    assert not np.array_equal(first[0, 0], first[0, 1])
    assert not np.array_equal(env.reset()[0], env.reset()[0])


@pytest.mark.parametrize("forkable", [True, False])
def test_each_environment_starts_by_its_own_seed(forkable):
    world = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False, forkable=forkable))
    try:
        env = as_env(world, num_envs=3)
        first = env.reset(seed=[3, 9, 4])[0]
        assert np.array_equal(first, env.reset(seed=(3, 9, 4))[0]) and len(np.unique(first[:, 0])) == 3
        assert np.array_equal(first[[2, 0, 1]], env.reset(seed=np.array([4, 3, 9]))[0])
        assert np.array_equal(env.reset(seed=3)[0], env.reset(seed=[3, 4, 5])[0])
        assert np.array_equal(env.reset(seed=[3, 4, 5])[0][:2], first[[0, 2]])
        chance = [env.reset(seed=[3, None, 4])[0] for _ in range(2)]
        assert np.array_equal(chance[0][[0, 2]], first[[0, 2]]) and not np.array_equal(chance[0][1], chance[1][1])
        kept = env.reset(seed=[3, 9, 4])[0]
        mask = np.array([False, True, True])
        part = env.reset(seed=[7, 8, 3], options={"reset_mask": mask})[0]
        assert np.array_equal(part[0], kept[0]) and np.array_equal(part[2], first[0])
    finally:
        world.close()
    single = as_env(GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False, forkable=forkable)))
    assert np.array_equal(single.reset(seed=[9])[0][0], first[1]) and np.array_equal(
        single.reset(seed=9)[0][0], first[1]
    )


@pytest.mark.parametrize("seed", [[1], [1, 2, 3], [1, -2], -1, [0, 2**64], [1.5, 2], "one"])
def test_seeds_that_are_not_one_for_each_environment_are_refused(cartpole, seed):
    with pytest.raises(TerrellaError, match="a list of one for each of 2 environments"):
        as_env(cartpole, num_envs=2).reset(seed=seed)


def test_what_happens_after_seeds_follows_from_them():
    """Dice of the dynamics and of later starts, too."""
    world = GymnasiumWorld("FrozenLake-v1", GymnasiumConfig(rgb=False))
    actions = np.random.default_rng(0).integers(0, 4, (60, 2))
    runs = []
    for seed in ([3, 4], 3, [3, 5]):
        env = as_env(world, num_envs=2)
        env.reset(seed=seed)
        runs.append(np.stack([env.step(action)[0] for action in actions]))
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])


def test_a_learned_world_starts_by_seeds_too():
    env = as_env(terrella.load("doom-maze", memory=False), num_envs=3)
    first = env.reset(seed=[1, 2, 1])[0]
    assert first.shape[0] == 3 and np.array_equal(first[0], first[2]) and not np.array_equal(first[0], first[1])
    assert np.array_equal(env.reset(seed=[2, 1, 7])[0][1], first[0])


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_it_is_as_gymnasiums_own_vector_environment(mode):
    """The same calls on SyncVectorEnv give the same types, shapes and infos at the same steps."""
    make = lambda: gymnasium.make("CartPole-v1", max_episode_steps=9)  # noqa: E731
    own = gymnasium.vector.SyncVectorEnv([make] * 2, autoreset_mode=mode)
    env = as_env(GymnasiumWorld(make, GymnasiumConfig(rgb=False)), num_envs=2, autoreset_mode=mode)
    assert (env.observation_space, env.action_space) == (own.observation_space, own.action_space)
    assert (env.single_observation_space, env.single_action_space) == (
        own.single_observation_space,
        own.single_action_space,
    )
    assert (
        env.metadata["autoreset_mode"] == own.metadata["autoreset_mode"] and env.unwrapped is env and env.spec is None
    )
    assert alike(env.reset(seed=[1, 2]), own.reset(seed=[1, 2]))
    for step in range(24):
        mine, theirs = (each.step(np.array([step % 2, 1 - step % 2])) for each in (env, own))
        assert alike(mine, theirs), (step, mine, theirs)
        if mode is AutoresetMode.DISABLED and (ended := mine[2] | mine[3]).any():
            assert alike(*(each.reset(seed=[None, 5], options={"reset_mask": ended.copy()}) for each in (env, own)))
    for each in (env, own):
        assert each.get_attr("render_mode") == each.call("render_mode") == (None, None)
        each.close(terminate=True)
        assert each.closed
        each.close()
    with pytest.raises(TerrellaError, match="closed"):
        env.step(np.array([0, 0]))


def alike(one, other) -> bool:
    """Whether both have the same types, dtypes, shapes, keys, and, where they are booleans, values."""
    if isinstance(one, dict):
        return isinstance(other, dict) and set(one) == set(other) and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, np.ndarray) and one.dtype == object:
        return other.dtype == object and all(map(alike, one, other))
    if isinstance(one, np.ndarray):
        same = one.dtype != bool or np.array_equal(one, other)
        return isinstance(other, np.ndarray) and (one.dtype, one.shape) == (other.dtype, other.shape) and same
    return type(one) is type(other)


NEXT_STEP, SAME_STEP = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP


@pytest.mark.parametrize(
    ("mode", "wrap"),
    [
        (NEXT_STEP, wrappers.DictInfoToList),
        (SAME_STEP, wrappers.DictInfoToList),
        (NEXT_STEP, wrappers.FlattenObservation),  # wrappers of observations take no other mode
        (SAME_STEP, lambda env: wrappers.TransformReward(env, lambda reward: reward * 2)),
        (SAME_STEP, lambda env: wrappers.TransformAction(env, lambda action: action)),
    ],
)
def test_each_kind_of_gymnasiums_wrappers_goes_on_over_ends(cartpole, mode, wrap):
    env = wrap(wrappers.RecordEpisodeStatistics(as_env(cartpole, num_envs=2, max_steps=6, autoreset_mode=mode)))
    env.reset(seed=[0, 1])
    ends = 0
    for step in range(20):
        actions = np.array([step % 2, 1])
        *_, terminated, truncated, infos = env.step(actions)
        ends += int((np.asarray(terminated) | np.asarray(truncated)).sum())
    assert ends >= 4
    env.close()


def test_actions_of_any_kind_of_array_are_taken(cartpole):
    env = as_env(cartpole, num_envs=2)
    fixed = np.array([0, 1])
    fixed.flags.writeable = False
    seen = []
    for actions in ([0, 1], (0, 1), fixed, np.array([0, 1], np.int32), torch.tensor([0, 1])):
        env.reset(seed=1)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            seen.append(env.step(actions)[0])
    assert all(np.array_equal(seen[0], one) for one in seen)


def test_a_world_without_observation_or_pictures_shows_all_its_channels():
    env = as_env(GymnasiumWorld("Blackjack-v1", GymnasiumConfig(rgb=False)))
    seen, _ = env.reset(seed=0)
    assert set(seen) == {"observation.0", "observation.1", "observation.2"} and seen in env.observation_space


def test_options_that_it_does_not_have_are_named(cartpole):
    with pytest.warns(UserWarning, match="no options level; they are ignored"):
        as_env(cartpole).reset(seed=0, options={"level": 3})


def test_next_step_autoreset_spends_a_step_on_the_new_start(film):
    env = as_env(film)
    seen, rewards, ends = [env.reset()[0][0, 0]], [], []
    for _ in range(6):
        observations, reward, terminated, truncated, infos = env.step(np.array([1]))
        seen.append(observations[0, 0])
        rewards.append(reward[0])
        ends.append((bool(terminated[0]), bool(truncated[0])))
        assert infos == {}
    assert seen == [0, 1, 2, 3, 4, 0, 1] and rewards == [1, 2, 3, 4, 0, 1]
    assert ends == [(False, False)] * 3 + [(True, False)] + [(False, False)] * 2


def test_same_step_autoreset_hands_over_the_final_observation(film):
    env = as_env(film, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP, observation=("observation",))
    env.reset()
    for step in range(1, 9):
        observations, rewards, terminated, truncated, infos = env.step(np.array([1, 0]))
        if step % 4:
            assert infos == {} and observations["observation"][0, 0] == step % 4
        else:
            assert terminated.all() and rewards.tolist() == [4, 4] and (observations["observation"] == 0).all()
            assert infos["_final_obs"].all() and infos["_final_info"].all() and infos["final_info"] == {}
            assert [entry["observation"].tolist() for entry in infos["final_obs"]] == [[4.0], [4.0]]


def test_disabled_autoreset_waits_for_a_reset_mask(cartpole):
    env = as_env(cartpole, num_envs=3, max_steps=2, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    env.step(np.array([0, 1, 0]))
    first = np.array([True, False, False])
    _, infos = env.reset(options={"reset_mask": first})
    *_, truncated, infos = env.step(np.array([0, 1, 0]))
    assert truncated.tolist() == [False, True, True]
    with pytest.raises(TerrellaError, match=r"\[1, 2\] have ended"):
        env.step(np.array([0, 1, 0]))
    before = env.state.at(0)
    env.reset(options={"reset_mask": ~first})
    assert env.state.at(0) == before
    *_, truncated, infos = env.step(np.array([0, 1, 0]))
    assert truncated.tolist() == [True, False, False]
    for mask in (np.zeros(3, bool), np.ones(2, bool), [True] * 3, np.ones(3)):
        with pytest.raises(TerrellaError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})


def test_stories_end_apart_and_their_neighbours_go_on(cartpole):
    """Under NEXT_STEP, an environment that did not end moves exactly as it would have moved alone."""
    env = as_env(cartpole, num_envs=2)
    env.reset(seed=1)
    alone, rng = env.state.at(1), make_rng(0)
    resets = 0
    for step in range(300):
        balance = int(env.state["observation"][1, 2] + 0.5 * env.state["observation"][1, 3] > 0)
        _, rewards, terminated, _, _ = env.step(np.array([1, balance]))
        resets += terminated[0]
        alone = cartpole.imagine(alone, torch.tensor([balance]), rng)
        assert torch.equal(env.state["observation"][1], alone["observation"][0]), step
    assert resets > 5


def test_truncation_comes_from_max_steps_alone(film):
    env = as_env(film, max_steps=2)
    env.reset()
    ends = [[bool(flag[0]) for flag in env.step(np.array([0]))[2:4]] for _ in range(5)]
    assert ends == [[False, False], [False, True], [False, False], [False, False], [False, True]]


def test_gymnasiums_wrappers_work_on_it(cartpole):
    plain = as_env(cartpole, num_envs=2, max_steps=40)
    env = wrappers.NormalizeObservation(wrappers.RecordEpisodeStatistics(plain))
    env = wrappers.NormalizeReward(wrappers.ClipReward(env, -1, 1))
    env.reset(seed=0)
    env.action_space.seed(0)
    lengths = []
    for _ in range(120):
        observations, rewards, *_, infos = env.step(env.action_space.sample())
        assert np.isfinite(observations).all() and np.isfinite(rewards).all()
        if "episode" in infos:
            lengths += infos["episode"]["l"][infos["_episode"]].tolist()
            assert (infos["episode"]["r"][infos["_episode"]] == infos["episode"]["l"][infos["_episode"]]).all()
    assert len(lengths) > 4 and max(lengths) <= 40


def test_arrays_that_were_handed_out_do_not_change(film):
    env = as_env(film, num_envs=2, observation=("observation", "rgb"))
    kept, _ = env.reset()
    kept["observation"] += 100
    first = env.step(np.array([0, 0]))[0]
    copies = {name: array.copy() for name, array in first.items()}
    env.step(np.array([0, 0]))
    assert all(np.array_equal(first[name], copies[name]) for name in first) and (first["observation"] == 1).all()


def test_it_draws_what_the_world_shows(film, cartpole):
    env = as_env(film, num_envs=2)
    env.reset()
    env.step(np.array([0, 0]))
    pictures = env.render()
    assert len(pictures) == 2 and pictures[0].shape == (4, 6, 3) and (pictures[1] == 1).all()
    assert env.metadata["render_fps"] == 10 and env.metadata["render_modes"] == ["rgb_array"]
    blind = as_env(cartpole)
    blind.reset()
    assert blind.render_mode is None and blind.render() is None


def test_a_time_limit_is_kept_and_is_no_termination(cartpole):
    assert as_env(cartpole).max_steps == 500 and as_env(cartpole, max_steps=math.inf).max_steps == math.inf
    car = GymnasiumWorld("MountainCar-v0", GymnasiumConfig(rgb=False))
    own = GymnasiumWorld(lambda: gymnasium.make("MountainCar-v0", max_episode_steps=200), GymnasiumConfig(rgb=False))
    for env in (as_env(car, 2), as_env(own, 2, max_steps=math.inf)):
        env.reset(seed=0)
        ends = [tuple(int(flag.sum()) for flag in env.step(np.array([1, 1]))[2:4]) for _ in range(200)]
        assert ends == [(0, 0)] * 199 + [(0, 2)]


def test_a_world_that_cannot_fork_is_one_environment():
    world = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False, forkable=False))
    env = as_env(world, max_steps=30)
    env.reset(seed=0)
    ends = sum(int((end := env.step(np.array([step % 2])))[2][0] or end[3][0]) for step in range(100))
    assert ends >= 2
    with pytest.raises(TerrellaError, match="1 to 64 episodes"):
        as_env(world, num_envs=65)


def test_bad_requests_are_answered_in_one_sentence(cartpole):
    with pytest.raises(ChannelError, match="cannot render 'rgb'"):
        as_env(cartpole, observation="rgb")
    with pytest.raises(TerrellaError, match="num_envs is 0"):
        as_env(cartpole, num_envs=0)
    with pytest.raises(TerrellaError, match="max_steps"):
        as_env(cartpole, max_steps=0)
    env = as_env(cartpole, num_envs=2)
    with pytest.raises(TerrellaError, match="reset"):
        env.step(np.array([0, 0]))
    env.reset()
    for junk in (np.array([0, 2]), np.array([0]), np.array([0.0, np.nan])):
        with pytest.raises(ActionError):
            env.step(junk)


class Trained:
    """A world that anybody may write: its weights want gradients."""

    def __init__(self):
        self.weight = torch.nn.Parameter(torch.ones(2))
        shown = {"observation": spaces.Box(-np.inf, np.inf, (2,), np.float32)}
        shown["reward"] = spaces.Box(-np.inf, np.inf, (), np.float32)
        self.spec = Spec("trained", spaces.Box(-1, 1, (2,), np.float32), shown, (), 0.1)

    def start(self, batch, rng):
        if batch < 1:
            raise TerrellaError("one or more")
        return State({"place": torch.zeros(batch, 2)})

    def observe(self, observation, prior, rng):
        return prior or self.start(1, rng)

    def imagine(self, state, action, rng):
        return state.replace(place=state["place"] + self.weight * self.spec.check_action(action, state.batch))

    def render(self, state, channels):
        self.spec.check_channels(channels)
        seen = {"observation": state["place"] * self.weight, "reward": (state["place"] * self.weight).sum(1)}
        return {name: seen[name] for name in channels}


def test_a_world_whose_weights_want_gradients_is_stepped_checked_and_recorded(tmp_path):
    world = Trained()
    env = as_env(world, num_envs=2, seed=0)
    env.reset()
    env.step(np.ones((2, 2), np.float32))
    assert "acts_deterministically" in check_world(world)
    assert record(world, Random(world.spec), tmp_path / "r", 4, make_rng(0)).rows == 4
