"""Flat arrays of many episodes, in the layouts that people share: each is cut where its episodes end."""

from __future__ import annotations

import numpy as np
import pytest

from terrella.core.errors import DatasetError
from terrella.data import Dataset
from terrella.exchange import open_source, write_source

ROWS, LENGTHS = 12, (5, 4, 3)  # the last episode of some layouts is unfinished
FIRST = np.isin(np.arange(ROWS), [0, 5, 9])
LAST = np.isin(np.arange(ROWS), [4, 8, 11])
STATE = np.arange(ROWS * 2, dtype=np.float32).reshape(ROWS, 2)
ACTION = np.arange(ROWS, dtype=np.float32)[:, None]
BOUNDS = {
    "OGBench": {"terminals": LAST.astype(np.float32)},
    "D4RL": {"terminals": np.arange(ROWS) == 4, "timeouts": np.arange(ROWS) == 8},
    "dones": {"dones": np.isin(np.arange(ROWS), [4, 8])},
    "Gymnasium": {"terminations": np.zeros(ROWS, bool), "truncations": LAST},
    "stable-baselines": {"episode_starts": FIRST, "episode_returns": np.zeros(3)},
    "Dreamer": {"is_first": FIRST, "is_last": LAST, "is_terminal": np.zeros(ROWS, bool)},
    "dm_env": {"step_type": np.where(FIRST, 0, np.where(LAST, 2, 1)), "discount": np.ones(ROWS)},
    "diffusion policy": {"meta/episode_ends": np.array([5, 9, 12])},
    "lengths": {"episode_lengths": np.array(LENGTHS)},
    "numbers": {"episode_index": np.repeat([7, 3, 9], LENGTHS)},
    "IQL": {"dones_float": LAST.astype(np.float32), "masks": np.ones(ROWS)},
    "RLlib": {"terminateds": np.arange(ROWS) == 4, "truncateds": np.arange(ROWS) == 8},
    "RLDS": {"steps/is_first": FIRST, "steps/is_last": LAST},
    "time limits": {"TimeLimit.truncated": LAST},
    "cumulative": {"cu_seqlens": np.array([0, 5, 9, 12])},
    "where it goes on": {"not_done": 1.0 - LAST},
    "discounts": {"discounts": np.where(LAST, 0.0, 0.99)},
    "MushroomRL": {"absorbing": np.zeros(ROWS, bool), "last": LAST},
    "first rows": {"path_starts": np.array([0, 5, 9])},
    "first rows and lengths": {"ep_offset": np.array([0, 5, 9]), "ep_len": np.array(LENGTHS)},
}


def saved(path, arrays: dict) -> None:
    if path.suffix == ".npz":
        return np.savez(path, **arrays)
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for key, values in arrays.items():
            file[key] = values


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
@pytest.mark.parametrize("layout", BOUNDS)
def test_every_layout_is_cut_where_its_episodes_end(tmp_path, layout, suffix):
    saved(tmp_path / f"a{suffix}", {"observations": STATE, "actions": ACTION, **BOUNDS[layout]})
    takes = list(open_source(tmp_path / f"a{suffix}").takes())
    for take, start, length in zip(takes, (0, 5, 9), LENGTHS, strict=True):
        np.testing.assert_array_equal(take.readings["observation.state"].values, STATE[start : start + length])
        np.testing.assert_array_equal(take.readings["action"].values, ACTION[start : start + length])
        np.testing.assert_allclose(take.readings["action"].time_s, np.arange(length) / 10)


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
def test_what_lies_beside_the_observations_is_kept_or_named(tmp_path, suffix):
    eye = np.random.default_rng(0).integers(0, 256, (ROWS, 40, 32, 3), np.uint8)
    more = {"qpos": np.arange(ROWS * 3.0).reshape(ROWS, 3), "wrist": eye, "goal": np.zeros(2), "gamma": np.array(0.9)}
    saved(tmp_path / f"a{suffix}", {"observations": STATE, "actions": ACTION, "terminals": LAST, **more})
    source = open_source(tmp_path / f"a{suffix}", fps=10)
    assert {"info.qpos", "observation.images.wrist"} <= set(source.sensors)
    assert sum("goal" in note for note in source.notes) == sum("gamma" in note for note in source.notes) == 1
    write_source(source, tmp_path / "set")
    data = Dataset(tmp_path / "set")
    assert [episode.length for episode in data.episodes] == list(LENGTHS)
    np.testing.assert_array_equal(data.episode(1)["info.qpos"], more["qpos"][5:9])


def test_terminal_observations_are_the_episodes_own(tmp_path):
    after = STATE + 0.5
    saved(tmp_path / "next.npz", {"obs": STATE, "next_obs": after, "acts": ACTION, "dones": LAST})
    saved(tmp_path / "more.npz", {"obs": np.arange(ROWS + 3.0), "acts": ACTION, "dones": LAST})
    saved(tmp_path / "end.npz", {"obs": np.arange(ROWS + 1.0), "acts": ACTION, "dones": LAST})
    seen = {
        name: [
            np.ravel(np.asarray(take.readings["observation.state"].values)).tolist()
            for take in open_source(tmp_path / name).takes()
        ]
        for name in ("next.npz", "more.npz", "end.npz")
    }
    assert seen["next.npz"][1] == [*STATE[5:9].ravel().tolist(), *after[8].tolist()]
    assert seen["more.npz"] == [list(range(6)), list(range(6, 11)), list(range(11, 15))]
    assert seen["end.npz"] == [list(range(5)), list(range(5, 9)), list(range(9, 13))]


def test_one_episode_that_is_done_twice_is_one(tmp_path):
    saved(tmp_path / "a.npz", {"observations": STATE, "actions": ACTION, "dones": np.arange(ROWS) > 9})
    (take,) = open_source(tmp_path / "a.npz").takes()
    assert len(take.readings["action"].values) == ROWS


def test_records_of_several_fields_and_files_without_observations_are_read(tmp_path):
    fields = np.zeros(ROWS, [("position", "f4", (3,)), ("grip", "f4")])
    fields["position"], fields["grip"] = np.arange(ROWS)[:, None], 7
    saved(tmp_path / "a.npz", {"observations": fields, "actions": ACTION, "terminals": LAST})
    (first, *_) = open_source(tmp_path / "a.npz").takes()
    np.testing.assert_array_equal(np.asarray(first.readings["observation.position"].values)[:, 2], np.arange(5))
    assert np.asarray(first.readings["observation.grip"].values).tolist() == [[7]] * 5
    more = {"data/is_last": LAST, "data/discount": np.ones(ROWS), "meta/episode_ends": np.array([5, 9, 12])}
    saved(tmp_path / "b.npz", {"data/action": ACTION, "data/state": STATE, **more})
    source = open_source(tmp_path / "b.npz")
    assert (
        set(source.sensors) == {"action", "observation.state", "info.is_last", "info.discount"}
        and len(list(source.takes())) == 3
    )
    assert any("no array has a name of observations" in note for note in source.notes)


def test_texts_are_the_task_or_named_and_pickles_are_named(tmp_path):
    order = np.repeat(["open the drawer", "close it", "wave"], LENGTHS)
    odd = np.array([{"a": 1}] * ROWS, object)
    arrays = {"observations": STATE, "actions": ACTION, "terminals": LAST, "mission": order, "env": np.array("maze")}
    saved(tmp_path / "a.npz", {**arrays, "infos": odd, "observations/said": np.arange(ROWS).astype(str)})
    notes = write_source(open_source(tmp_path / "a.npz"), tmp_path / "set")
    assert [episode.task for episode in Dataset(tmp_path / "set").episodes] == ["open the drawer", "close it", "wave"]
    for name in ("infos", "env", "observations/said"):
        assert any(name in note for note in notes), name


def test_what_has_no_row_for_each_step_of_one_episode_is_named(tmp_path):
    h5py = pytest.importorskip("h5py")
    odd = {"goal": np.zeros(2), "matrix": np.zeros((1, ROWS)), "terminals": np.full(ROWS, np.nan)}
    saved(
        tmp_path / "a.hdf5", {"action": ACTION, "observations/images/top": np.zeros((ROWS, 40, 32, 3), np.uint8), **odd}
    )
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["nothing"] = h5py.Empty("f")
    source = open_source(tmp_path / "a.hdf5", fps=10)
    assert set(source.sensors) == {"action", "observation.images.top", "next.done"} and len(list(source.takes())) == 1
    assert [sum(f"'{name}'" in note for note in source.notes) for name in ("goal", "matrix", "nothing")] == [1, 1, 1]


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
def test_where_nothing_marks_an_end_it_is_said(tmp_path, suffix):
    for flags in ({}, {"terminals": np.zeros(ROWS, bool)}):
        saved(tmp_path / f"a{suffix}", {"observations": STATE, "actions": ACTION, **flags})
        source = open_source(tmp_path / f"a{suffix}")
        assert sum("nothing marks the end of an episode: the 12 rows" in note for note in source.notes) == 1
    saved(tmp_path / f"a{suffix}", {"observations": STATE, "actions": ACTION, "terminals": np.arange(ROWS) == ROWS - 1})
    assert not any("marks" in note for note in open_source(tmp_path / f"a{suffix}").notes)


def test_episodes_beside_each_other_are_refused(tmp_path):
    flags, more = LAST.reshape(3, 4), {"observations": STATE.reshape(3, 4, 2), "actions": ACTION.reshape(3, 4, 1)}
    saved(tmp_path / "a.npz", {**more, "terminals": flags})
    with pytest.raises(DatasetError, match=r"'terminals'.*\[3, 4.*one after another"):
        open_source(tmp_path / "a.npz")


def test_bounds_that_do_not_fit_are_refused(tmp_path):
    for bounds in (
        {"path_starts": np.array([0, 99])},
        {"episode_ends": np.array([5, 99])},
        {"episode_ends": np.array([5, 5])},
    ):
        saved(tmp_path / "a.npz", {"observations": STATE, "actions": ACTION, **bounds})
        with pytest.raises(DatasetError, match="does not fit its 12 rows"):
            open_source(tmp_path / "a.npz")


def test_a_file_of_one_step_is_refused_and_pictures_of_floats_and_pickles_are_named(tmp_path):
    picture = np.zeros((40, 48, 3), np.uint8)
    for number in (7, 8):  # as CALVIN keeps them
        saved(
            tmp_path / f"episode_{number}.npz",
            {"actions": np.zeros(7), "robot_obs": np.zeros(15), "rgb_static": picture},
        )
    with pytest.raises(DatasetError, match=r"a single step \('rgb_static' is one picture\); stack"):
        open_source(tmp_path)
    (tmp_path / "f").mkdir()
    bright = np.full((ROWS, 40, 48, 3), 0.5, np.float32)
    saved(tmp_path / "f" / "a.npz", {"observations": STATE, "actions": ACTION, "terminals": LAST, "eye": bright})
    assert any("'eye' is kept as numbers; pictures are bytes" in note for note in open_source(tmp_path / "f").notes)
    ragged = np.array([STATE, STATE[:3]], object)
    np.savez(tmp_path / "f" / "a.npz", observations=ragged, actions=ACTION)
    with pytest.raises(DatasetError, match="'observations' is left out: it is a pickle, which is not opened"):
        open_source(tmp_path / "f")


def test_names_that_no_sensor_can_have_are_changed_and_named(tmp_path):
    odd = {"observations/a b": STATE, "observations/a_b": STATE[:, :1], "observations/größe": ACTION}
    saved(tmp_path / "a.npz", {**odd, "actions": ACTION, "terminals": LAST})
    source = open_source(tmp_path / "a.npz")
    assert {"observation.a_b", "observation.a_b_2", "observation.gr_e"} <= set(source.sensors)
    said = [note for note in source.notes if "is called" in note]
    assert len(said) == 3 and any("'observations/größe' is called 'observation.gr_e'" in note for note in said)


def test_a_group_for_each_episode(tmp_path):
    counts, look = (4, 3), np.random.default_rng(0).random((5, 24, 32), np.float32)
    for number, head in enumerate(("traj_", "", "data/demo-", "trajectories/episode ")):
        arrays = {"about": np.zeros(3)}
        for episode, count in enumerate(counts):
            more = {
                "obs/agent/qpos": STATE[: count + 1],
                "obs/hand_depth": look[: count + 1],
                "actions": ACTION[:count],
            }
            arrays |= {f"{head}{episode + 9}/{key}": values for key, values in more.items()}  # 9 before 10
        saved(tmp_path / f"{number}.hdf5", arrays)
        source = open_source(tmp_path / f"{number}.hdf5", fps=20)
        assert sum("'about' is left out" in note for note in source.notes) == 1
        for take, count in zip(source.takes(), counts, strict=True):
            seen = {name: np.stack(list(it.values)) for name, it in take.readings.items()}
            np.testing.assert_array_equal(seen["observation.agent.qpos"], STATE[: count + 1])
            np.testing.assert_array_equal(seen["action"], ACTION[:count])
            np.testing.assert_array_equal(seen["observation.depth.hand"], look[: count + 1])


def test_names_of_tianshou_and_the_next_state_of_another(tmp_path):
    after = STATE + 0.5
    saved(tmp_path / "a.npz", {"obs": STATE, "act": ACTION, "rew": ROWS - ACTION, "done": LAST, "obs_next": after})
    saved(tmp_path / "b.npz", {"state": STATE, "action": ACTION, "last": LAST, "next_state": after})
    one, other = (list(open_source(tmp_path / name).takes()) for name in ("a.npz", "b.npz"))
    assert set(one[1].readings) == {"observation.state", "action", "next.reward", "next.done"}
    np.testing.assert_array_equal(one[1].readings["observation.state"].values, [*STATE[5:9], after[8]])
    assert not any("next_state" in name for name in other[0].readings), "what comes next is no observation"
