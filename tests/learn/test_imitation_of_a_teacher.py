"""A recorded teacher is imitated in the place of the actions that were taken; a policy sees where small things are."""

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tests.learn.stopping import quiet

from terrella.act.imitation_network import ImitationNetwork, spatial_softmax
from terrella.act.teacher import Teacher
from terrella.core.policy import Random
from terrella.core.world import make_rng
from terrella.data import Dataset, record
from terrella.learn.copycat import copycat
from terrella.learn.demonstrations import DemonstrationRows
from terrella.learn.recipes.imitation import Imitation, config_of, open_demonstrations
from terrella.learn.recipes.latent import vectors_of
from terrella.learn.recording import Recording
from terrella.sim.gymnasium import GymnasiumWorld


class Home(gymnasium.Env):
    """A place from -1 to 1, and the teacher's advice: half the way home."""

    action_space = spaces.Box(-0.5, 0.5, (1,), np.float32)
    observation_space = spaces.Dict(
        {"place": spaces.Box(-1, 1, (1,), np.float32), "expert": spaces.Box(-0.5, 0.5, (1,), np.float32)}
    )
    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 1).astype(np.float32), 0
        return self.seen(), {}

    def step(self, action):
        self.place, self.steps = np.clip(self.place + action, -1, 1).astype(np.float32), self.steps + 1
        return self.seen(), 0.0, False, self.steps >= 10, {}

    def seen(self):
        return {"place": self.place, "expert": -0.5 * self.place}


if "TerrellaHome-v0" not in gymnasium.registry:
    gymnasium.register("TerrellaHome-v0", lambda **_: Home())


def rows_of(policy, folder):
    world = GymnasiumWorld("TerrellaHome-v0")
    record(world, policy(world.spec), folder, 200, make_rng(0))
    opened, sees = open_demonstrations(folder, (), (64, 64), quiet)
    assert sees == ("place",)
    config = config_of(opened, sees, 16, Imitation(own_actions=True))
    return DemonstrationRows.of(opened, config, torch.device("cpu")), opened


def test_the_teachers_advice_is_imitated_where_another_policy_acted(tmp_path):
    rows, opened = rows_of(Random, tmp_path / "random")
    advised, place = rows.advised, torch.from_numpy(np.array(opened.cache.arrays["observation.place"]))
    assert torch.allclose(advised.actions, -place.reshape(-1, 1), atol=1e-5)  # in half ranges
    assert advised.taken is rows.actions and not torch.allclose(rows.actions, advised.actions, atol=0.1)
    moments = rows.rows[rows.rows > rows.recording.start[rows.rows]][:50]
    mine, theirs = advised.at(moments), rows.at(moments)
    assert torch.equal(mine.acted, theirs.acted)  # what it did before is what was done
    assert torch.equal(mine.chunk[:, 0], advised.actions[moments])


def test_a_teacher_without_noise_is_imitated_as_before(tmp_path):
    rows, _ = rows_of(Teacher, tmp_path / "teacher")
    valid = rows.valid.nonzero()[0]
    assert torch.allclose(rows.advised.actions[valid], rows.actions[valid], atol=1e-5)


def test_a_policys_own_episodes_go_into_the_teachers_recording(tmp_path):
    record(
        GymnasiumWorld("TerrellaHome-v0"),
        Teacher(GymnasiumWorld("TerrellaHome-v0").spec),
        tmp_path / "both",
        100,
        make_rng(0),
    )
    rows, opened = rows_of(Random, tmp_path / "both")
    right = (rows.advised.actions - rows.actions).abs().amax(1) < 1e-5
    assert right[:90][rows.valid[:90]].all() and not right[110:].any()
    place = torch.from_numpy(np.array(opened.cache.arrays["observation.place"])).reshape(-1, 1)
    assert torch.allclose(rows.advised.actions, -place, atol=1e-5)


def test_episodes_without_a_teacher_keep_the_actions_that_were_taken(tmp_path):
    rows, opened = rows_of(Random, tmp_path / "random")
    opened.cache.absent["observation.expert"] = [1]
    first, stop = opened.cache.episodes[1]
    advised = rows.advised
    assert torch.equal(advised.actions[first:stop], rows.actions[first:stop])
    assert not torch.allclose(advised.actions[:first], rows.actions[:first], atol=0.1)


def test_a_copy_of_the_last_action_is_of_the_one_that_was_taken(tmp_path):
    rows, _ = rows_of(Random, tmp_path / "random")
    rows = rows.advised
    inside = torch.from_numpy(rows.rows[rows.rows > rows.recording.start[rows.rows]])
    truth, last = rows.actions[inside], rows.taken[inside - 1]
    explained = 1 - (truth - last).square().mean() / (truth - truth.mean(0)).square().mean()
    figures = copycat(ImitationNetwork(rows.config), rows, 10_000)
    assert abs(figures["held_out_copy_last"] - float(explained)) < 1e-3


def test_spatial_softmax_finds_a_dot_between_two_pixels():
    maps = torch.full((1, 2, 5, 9), -50.0)
    maps[0, 0, 1, 8] = 50.0
    maps[0, 1, 4, 3] = maps[0, 1, 4, 4] = 50.0
    x, y = spatial_softmax(maps).view(2, 2)
    assert torch.allclose(x, torch.tensor([1.0, -0.125])) and torch.allclose(y, torch.tensor([-0.5, 1.0]))


def test_no_learner_sees_the_teachers_advice_or_masks_unless_it_names_them(tmp_path):
    rows_of(Random, tmp_path / "random")
    recording = Recording.open(
        Dataset(tmp_path / "random"), (64, 64), quiet, needs=("action",), why="a test"
    ).require_rows()
    assert vectors_of(recording) == (("place", 1),)
    assert vectors_of(recording, ("expert", "place")) == (("expert", 1), ("place", 1))
    recording.cache.keys["place_mask"] = recording.cache.keys["place"]  # as of a merged recording
    assert vectors_of(recording) == (("place", 1),)
