"""Arrays [episodes, steps, ...], padded at their end: each episode keeps its own steps alone."""

from __future__ import annotations

import numpy as np
import pytest
from tests.exchange.test_flat import saved

from terrella.core.errors import DatasetError
from terrella.exchange import open_source

LENGTHS, STEPS = (6, 4, 6, 5), 6
VALID = np.arange(STEPS) < np.array(LENGTHS)[:, None]
END = np.arange(STEPS) == np.array(LENGTHS)[:, None] - 1
STATE = np.arange(4 * STEPS * 3, dtype=np.float32).reshape(4, STEPS, 3) + 1
ACTION = (STATE[..., :2] + 100) * VALID[..., None]
BOUNDS = {
    "lengths": {"lengths": np.array(LENGTHS)},
    "path lengths": {"path_lengths": np.array(LENGTHS)[:, None]},
    "a mask": {"masks": VALID.astype(np.float32)},
    "padding": {"is_pad": ~VALID},
    "one end each": {"dones": END},
    "ends that stay": {"terminals": ~VALID | END, "timeouts": np.zeros_like(END)},
    "last steps": {"is_last": END[..., None]},
}


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
@pytest.mark.parametrize("bounds", BOUNDS)
def test_stacked_episodes_keep_their_own_steps(tmp_path, bounds, suffix):
    arrays = {"observations": STATE, "actions": ACTION, "rewards": STATE[..., 0], "returns": np.zeros(4)}
    saved(tmp_path / f"a{suffix}", arrays | BOUNDS[bounds])
    source = open_source(tmp_path / f"a{suffix}", fps=10)
    for number, take in enumerate(source.takes()):
        count, seen = LENGTHS[number], take.readings
        np.testing.assert_array_equal(seen["observation.state"].values, STATE[number, :count])
        np.testing.assert_array_equal(seen["action"].values, ACTION[number, :count])
        np.testing.assert_array_equal(np.ravel(np.asarray(seen["next.reward"].values)), STATE[number, :count, 0])
    assert number == 3 and sum("'returns'" in note for note in source.notes) == 1


def test_a_last_observation_pictures_and_an_instruction_each_are_kept(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (4, STEPS + 1, 40, 32, 3), np.uint8)
    arrays = {"obs/eye": picture, "actions": ACTION[..., 0], "traj_lengths": np.array(LENGTHS)}
    saved(tmp_path / "a.npz", arrays | {"instruction": np.array(["push", "pull", "push", "lift"])})
    takes = list(open_source(tmp_path / "a.npz", fps=10).takes())
    assert [take.task for take in takes] == ["push", "pull", "push", "lift"]
    for number, (take, count) in enumerate(zip(takes, LENGTHS, strict=True)):
        eye = take.readings["observation.images.eye"]
        assert len(eye.time_s) == count + 1 and len(take.readings["action"].time_s) == count
        np.testing.assert_array_equal(eye.values[count], picture[number, count])


def test_environments_side_by_side_are_no_stacked_episodes(tmp_path):
    dones = np.array([[0, 0], [1, 0], [0, 0], [0, 1]], bool)  # [steps, environments]
    saved(tmp_path / "a.npz", {"obs": STATE[:, :2], "actions": STATE[:, :2, :1], "dones": dones})
    with pytest.raises(DatasetError, match="'dones'.*add the array 'episode_lengths'"):
        open_source(tmp_path / "a.npz")


def test_actions_of_several_axes_alone_are_named(tmp_path):
    saved(tmp_path / "a.npz", {"obs": STATE, "actions": ACTION})
    source = open_source(tmp_path / "a.npz", fps=10)
    assert sum("add an array 'episode_lengths'" in note for note in source.notes) == 1
    assert len(list(source.takes())) == 1


def test_lengths_beyond_the_steps_are_refused(tmp_path):
    saved(tmp_path / "a.npz", {"obs": STATE, "actions": ACTION, "lengths": np.array([6, 7, 6, 5])})
    with pytest.raises(DatasetError, match="'lengths'.*does not fit its 6 steps"):
        open_source(tmp_path / "a.npz")


def test_a_row_for_each_step_is_no_stack_of_episodes(tmp_path):
    """Two actions beside three or two numbers observed are no two steps of an episode."""
    for name, count in (("a", 3), ("b", 2)):
        saved(tmp_path / f"{name}.npz", {"obs": np.ones((20, count), np.float32), "actions": np.ones((20, 2))})
        source = open_source(tmp_path / f"{name}.npz", fps=10)
        assert not any("episode_lengths" in note for note in source.notes) and len(list(source.takes())) == 1


def test_no_episodes_and_bounds_before_the_first_row_are_refused_in_a_sentence(tmp_path):
    saved(tmp_path / "a.npz", {"obs": STATE[:0], "actions": ACTION[:0], "lengths": np.zeros(0, int)})
    with pytest.raises(DatasetError, match="0 observations"):
        list(open_source(tmp_path / "a.npz", fps=10).takes())
    bounds = {"episode_ends": np.array([-5, 9, 20])}
    saved(tmp_path / "b.npz", {"obs": np.ones((20, 3)), "actions": np.ones((20, 2)), **bounds})
    with pytest.raises(DatasetError, match="'episode_ends'.*does not fit"):
        open_source(tmp_path / "b.npz")
