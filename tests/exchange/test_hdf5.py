"""HDF5 in robomimic's, DIAMOND's and D4RL's layouts, as their authors describe them, written here with h5py alone."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from terrella.core.errors import DatasetError
from terrella.data.source import Readings, Sensor, Source, Take

h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'terrella[hdf5]'")

from terrella.exchange.formats import counter_strike, hdf5, hdf5_file, robomimic, rows  # noqa: E402
from terrella.exchange.formats.arrays import Array  # noqa: E402


def stacked(readings: Readings) -> np.ndarray:
    return np.stack(list(readings.values))


# -- robomimic


def robomimic_file(path, demos=(("demo_10", 4), ("demo_2", 3)), next_obs=True, **changes):
    """A file as robomimic's documentation lays it out; picture (d, t) is all 10 d + t."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(n for _, n in demos)
        env = {"env_name": "Lift", "env_type": 1, "env_kwargs": {"control_freq": 20, "robots": ["Panda"]}}
        data.attrs["env_args"] = json.dumps(env)
        for d, (name, n) in enumerate(demos):
            demo = data.create_group(name)
            demo.attrs["num_samples"], demo.attrs["model_file"] = n, "<mujoco/>" * 20_000
            rows_of = np.arange(n + 1)
            obs = {
                "agentview_image": np.broadcast_to(10 * d + rows_of[:, None, None, None], (n + 1, 12, 10, 3)).astype(
                    "u1"
                ),
                "agentview_depth": np.broadcast_to(rows_of[:, None, None, None] / 4, (n + 1, 6, 5, 1)).astype("f4"),
                "robot0_eef_pos": np.stack([rows_of / 8, rows_of, -rows_of], 1),
                "object": np.stack([rows_of, rows_of], 1).astype("f4"),
            }
            for key, values in obs.items():
                demo[f"obs/{key}"] = values[:-1]
                if next_obs:
                    demo[f"next_obs/{key}"] = values[1:]
            demo["actions"] = np.arange(n * 7, dtype=float).reshape(n, 7)
            demo["states"] = np.arange(n * 5, dtype=float).reshape(n, 5)
            demo["rewards"], demo["dones"] = np.linspace(0, 1, n), np.eye(n, dtype=np.int64)[-1]
        file["mask/train"] = np.array([b"demo_10"])
        file["mask/valid"] = np.array([b"demo_2"])
        for key, value in changes.items():
            del file[f"data/demo_10/{key}"]
            if value is not None:
                file[f"data/demo_10/{key}"] = value
    return path


def test_robomimic_is_read_with_its_last_observation_and_filter_keys(tmp_path):
    source = hdf5.read(robomimic_file(tmp_path / "lift.hdf5"))
    assert {name: (s.kind, s.shape, s.dtype) for name, s in source.sensors.items()} == {
        "observation.images.agentview": ("image", (12, 10, 3), "uint8"),
        "observation.depth.agentview": ("depth", (6, 5), "float32"),
        "observation.robot0_eef_pos": ("vector", (3,), "float64"),
        "observation.object": ("vector", (2,), "float32"),
        "action": ("vector", (7,), "float64"),
        "info.states": ("vector", (5,), "float64"),
        "next.reward": ("vector", (1,), "float64"),
        "next.done": ("vector", (1,), "bool"),
    }
    assert source.fps == 20 and source.robot == "Panda" and source.notes == ()
    assert source.facts["robomimic"]["env_args"]["env_name"] == "Lift"
    assert source.facts["robomimic"]["mask"] == {"train": ["demo_10"], "valid": ["demo_2"]}
    two, ten = source.takes()
    assert [take.facts["robomimic"]["demo"] for take in (two, ten)] == ["demo_2", "demo_10"]
    assert ten.facts["robomimic"]["attributes"]["model_file"].startswith("<mujoco/>")
    pictures = ten.readings["observation.images.agentview"]
    assert [int(value[0, 0, 0]) for value in pictures.values] == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(pictures.time_s, np.arange(5) / 20)
    assert ten.readings["observation.depth.agentview"].values[4][2, 2] == 1.0
    assert ten.readings["observation.robot0_eef_pos"].values[:, 1].tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(ten.readings["action"].time_s, np.arange(4) / 20)
    assert ten.readings["next.done"].values.ravel().tolist() == [False] * 3 + [True]


def everything(file) -> dict:
    found = {}

    def see(name, item):
        attrs = {key: value for key, value in item.attrs.items() if key != hdf5_file.OURS}
        values = (item[()].tolist(), str(item.dtype), item.shape) if isinstance(item, h5py.Dataset) else None
        found[name] = (values, str(attrs))

    file.visititems(see)
    return found


@pytest.mark.parametrize("next_obs", [True, False])
def test_robomimic_comes_back_as_it_was(tmp_path, next_obs):
    robomimic_file(tmp_path / "a.hdf5", next_obs=next_obs)
    assert robomimic.write(hdf5.read(tmp_path / "a.hdf5"), tmp_path / "b.hdf5") == []
    robomimic.write(hdf5.read(tmp_path / "b.hdf5"), tmp_path / "c.hdf5")
    with h5py.File(tmp_path / "a.hdf5") as a, h5py.File(tmp_path / "b.hdf5") as b, h5py.File(tmp_path / "c.hdf5") as c:
        assert everything(a) == everything(b) == everything(c)


@settings(max_examples=15)
@given(
    state=hnp.arrays(np.float32, (5, 3), elements=st.floats(allow_nan=False, width=32)),
    action=hnp.arrays(np.int64, (5, 2)),
    picture=hnp.arrays(np.uint8, (5, 3, 4, 3)),
    done=hnp.arrays(np.bool_, (5, 1)),
    terminal=st.booleans(),
    task=st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
)
def test_write_read_write_is_the_identity(tmp_path_factory, state, action, picture, done, terminal, task):
    folder = tmp_path_factory.mktemp("h")
    steps, time_s = 5 - terminal, np.arange(5) / 8
    sensors = {
        s.name: s
        for s in (
            Sensor("observation.state", "vector", (3,), "float32", ("x", "y", "z"), {"x": "m"}, "world"),
            Sensor("observation.images.front", "image", (3, 4, 3), "uint8", rate_hz=8.0, facts={"calibration": [1.5]}),
            Sensor("action", "vector", (2,), "int64", ("left", "right")),
            Sensor("next.done", "vector", (1,), "bool"),
            Sensor("next.truncated", "vector", (1,), "bool"),
        )
    }
    values = {"observation.state": state, "observation.images.front": picture, "action": action[:steps],
              "next.done": done[:steps], "next.truncated": ~done[:steps]}  # fmt: skip
    take = Take({name: Readings(time_s[: len(v)], v) for name, v in values.items()}, task)
    source = Source("made", sensors, lambda: iter([take, take]), 8.0, "arm", facts={"x": [1]})
    assert robomimic.write(source, folder / "a.hdf5") == []
    first = hdf5.read(folder / "a.hdf5")
    robomimic.write(first, folder / "b.hdf5")
    for found in (first, hdf5.read(folder / "b.hdf5")):
        assert (found.fps, found.robot, found.name, found.facts["x"]) == (8.0, "arm", "made", [1])
        for name, sensor in sensors.items():
            mine = found.sensors[name]
            assert (mine.names, mine.units, mine.frame, mine.dtype) == (
                sensor.names,
                sensor.units,
                sensor.frame,
                sensor.dtype,
            )
        assert found.sensors["observation.images.front"].facts == {"calibration": [1.5]}
        takes = list(found.takes())
        assert [t.task for t in takes] == [task, task]
        for name, value in values.items():
            assert stacked(takes[1].readings[name]).dtype == value.dtype
            np.testing.assert_array_equal(stacked(takes[1].readings[name]), value)
            np.testing.assert_array_equal(takes[1].readings[name].time_s, time_s[: len(value)])


def test_pictures_are_read_when_looked_at(tmp_path, monkeypatch):
    source = hdf5.read(robomimic_file(tmp_path / "a.hdf5"))
    reads, original = [], hdf5_file.concatenated

    def counted(*given) -> Array:
        array = original(*given)
        return replace(array, read=lambda *at: (reads.append((len(array.shape), *at)), array.read(*at))[1])

    monkeypatch.setattr(hdf5_file, "concatenated", counted)
    take = next(iter(source.takes()))
    assert reads and all(dimensions < 4 for dimensions, *_ in reads)
    reads.clear()
    assert take.readings["observation.images.agentview"].values[1][0, 0, 0] == 11
    assert reads == [(4, 1, 2)]


def test_a_folder_is_the_takes_of_its_files(tmp_path):
    robomimic_file(tmp_path / "part10.hdf5", (("demo_0", 2),))
    robomimic_file(tmp_path / "part9.h5", (("demo_0", 3),))
    assert [len(take.readings["action"].values) for take in hdf5.read(tmp_path).takes()] == [3, 2]
    with h5py.File(tmp_path / "part10.hdf5", "a") as file:
        del file["data/demo_0/obs/object"]
    assert ["observation.object" in take.readings for take in hdf5.read(tmp_path).takes()] == [True, False]
    with h5py.File(tmp_path / "part10.hdf5", "a") as file:
        file["data/demo_0/obs/object"] = np.zeros((2, 9))
    with pytest.raises(DatasetError, match=r"part10\.hdf5 has other sensors"):
        hdf5.read(tmp_path)


def test_bad_robomimic_files_are_named(tmp_path):
    for changes, match in [
        ({"actions": np.zeros((3, 7))}, "has 3 actions where num_samples says 4"),
        ({"actions": np.zeros((4, 6))}, r"is \[6\] a row where the first episode has \[7\]"),
        ({"obs/object": np.zeros((3, 2))}, "has 3 rows where 4 are needed"),
        ({"obs/object": np.array([b"a"] * 4)}, "not an array of numbers"),
    ]:
        robomimic_file(tmp_path / "a.hdf5", **changes)
        with pytest.raises(DatasetError, match=match):
            list(hdf5.read(tmp_path / "a.hdf5").takes())


def test_what_robomimic_cannot_hold_is_said_and_nothing_is_left_behind(tmp_path):
    def source_of(**values) -> Source:
        sensors = {n: Sensor(n, "vector", v.shape[1:], v.dtype.name) for n, v in values.items()}
        take = Take({n: Readings(np.arange(len(v), dtype=float), v) for n, v in values.items()})
        return Source("s", sensors, lambda: iter([take]), 1.0)

    state, action = np.zeros((4, 2)), np.zeros((3, 1))
    for values, match in [
        ({"observation.state": state}, "no 'action'"),
        ({"observation.state": state, "action": action[:1]}, "4 observations and 1 actions"),
        ({"observation.state": state, "action": action[:0]}, "and 0 actions"),
        ({"observation.a": state, "observation.b": state[:2], "action": action}, "different rates"),
    ]:
        with pytest.raises(DatasetError, match=match):
            robomimic.write(source_of(**values), tmp_path / "out.hdf5")
    assert list(tmp_path.iterdir()) == []
    notes = robomimic.write(
        source_of(**{"observation.state": state, "action": action, "lidar": state}), tmp_path / "out.hdf5"
    )
    assert notes == ["'lidar' has no place in robomimic's layout and was left out."]
    with pytest.raises(DatasetError, match="exists already"):
        robomimic.write(source_of(action=action), tmp_path / "out.hdf5")


# -- Counter-Strike


def csgo_file(path, frames=5, shape=(30, 40, 3)):
    with h5py.File(path, "w") as file:
        for i in range(frames):
            file[f"frame_{i}_x"] = np.broadcast_to(np.array([i % 256, 100, 200], np.uint8), shape)  # blue, green, red
            action = np.zeros(51)
            action[[0, 11, 13 + 11, 36 + 7]] = 1  # w, left button, no mouse
            action[4] = i == 2  # space
            file[f"frame_{i}_xaux"] = np.full(54, i / 8)
            file[f"frame_{i}_y"] = action
            file[f"frame_{i}_helperarr"] = np.array([i == 3, 0.0])


def test_counter_strike_pictures_are_turned_to_rgb_and_actions_named(tmp_path):
    (tmp_path / "1-200").mkdir()
    csgo_file(tmp_path / "1-200" / "hdf5_dm_july2021_10.hdf5", 4)
    csgo_file(tmp_path / "1-200" / "hdf5_dm_july2021_9.hdf5")
    source = hdf5.read(tmp_path)
    assert source.fps == 16 and len(source.sensors["action"].names) == 51 == len(set(source.sensors["action"].names))
    assert len(source.sensors["observation.xaux"].names) == 54
    names = source.sensors["action"].names
    assert names[:5] == ("w", "a", "s", "d", "space") and names[11:13] == ("mouse_left", "mouse_right")
    assert names[13] == "mouse_x=-1000" and names[24] == "mouse_x=0" and names[35] == "mouse_x=1000"
    assert names[36] == "mouse_y=-200" and names[43] == "mouse_y=0" and names[50] == "mouse_y=200"
    nine, ten = source.takes()
    assert nine.facts["file"] == "1-200/hdf5_dm_july2021_9.hdf5"
    assert [len(take.readings["action"].values) for take in (nine, ten)] == [5, 4]
    pictures = nine.readings["observation.images.rgb"]
    assert [pictures.values[i][3, 3].tolist() for i in (4, 0, -1)] == [[200, 100, 4], [200, 100, 0], [200, 100, 4]]
    np.testing.assert_array_equal(pictures.time_s, np.arange(5) / 16)
    assert nine.readings["action"].values[:, 4].tolist() == [0, 0, 1, 0, 0]
    assert nine.readings["observation.events"].values[:, 0].tolist() == [0, 0, 0, 1, 0]
    assert (
        next(iter(hdf5.read(tmp_path / "1-200" / "hdf5_dm_july2021_10.hdf5").takes())).facts["file"].endswith("10.hdf5")
    )
    assert len(counter_strike.ACTION) == 51


def test_counter_strike_with_holes_is_refused(tmp_path):
    for name, change in (("frame_2_y", None), ("frame_2_x", None), ("frame_2_x", np.zeros((3, 4, 3), np.uint8))):
        csgo_file(tmp_path / "a.hdf5")
        with h5py.File(tmp_path / "a.hdf5", "a") as file:
            del file[name]
            if change is not None:
                file[name] = change
        with pytest.raises(DatasetError, match="frame_"):
            for take in hdf5.read(tmp_path / "a.hdf5").takes():
                list(take.readings["observation.images.rgb"].values)


# -- D4RL


def d4rl_file(path, next_observations=False, timeouts=True, picture=False):
    with h5py.File(path, "w") as file:
        count = 10
        shape = (count, 34, 33, 3) if picture else (count, 2)
        file["observations"] = np.arange(np.prod(shape)).reshape(shape).astype("u1" if picture else "f4")
        if next_observations:
            file["next_observations"] = file["observations"][()] + np.array(1, file["observations"].dtype)
        file["actions"] = np.arange(count * 3, dtype="f4").reshape(count, 3)
        file["rewards"] = np.arange(count, dtype="f4")
        file["terminals"] = np.arange(count) == 3
        if timeouts:
            file["timeouts"] = np.arange(count) == 7
        file["infos/qpos"] = np.arange(count * 2.0).reshape(count, 2)
        file["infos/action_log_probs"] = np.arange(count, dtype="f4")
        file["metadata/algorithm"] = "SAC"
        file["metadata/policy/fc0/weight"] = np.zeros((3, 3))


@pytest.mark.parametrize("next_observations", [False, True])
def test_flat_arrays_are_cut_at_terminals_and_timeouts(tmp_path, next_observations):
    d4rl_file(tmp_path / "hopper.hdf5", next_observations)
    source = hdf5.read(tmp_path / "hopper.hdf5", fps=125)
    assert set(source.sensors) == {"observation.state", "action", "next.reward", "next.done", "next.truncated",
                                   "info.qpos", "info.action_log_probs"}  # fmt: skip
    assert source.facts["d4rl"]["metadata"] == {"algorithm": "SAC"}
    assert len(source.notes) == 1 and "policy/fc0/weight" in source.notes[0]
    takes = list(source.takes())
    assert [take.readings["next.reward"].values.ravel().tolist() for take in takes] == [
        [0, 1, 2, 3], [4, 5, 6, 7], [8, 9],
    ]  # fmt: skip
    assert [len(take.readings["observation.state"].values) for take in takes] == [
        n + next_observations for n in (4, 4, 2)
    ]
    if next_observations:
        np.testing.assert_array_equal(takes[1].readings["observation.state"].values[-1], np.float32([15, 16]))
    assert takes[0].readings["next.done"].values.ravel().tolist() == [False] * 3 + [True]
    assert takes[1].readings["next.truncated"].values.ravel().tolist() == [False] * 3 + [True]
    np.testing.assert_array_equal(takes[2].readings["info.qpos"].values, [[16, 17], [18, 19]])
    assert "1/10 s" in hdf5.read(tmp_path / "hopper.hdf5").notes[1]
    robomimic.write(source, tmp_path / "again.hdf5")
    again = list(hdf5.read(tmp_path / "again.hdf5").takes())
    for mine, theirs in zip(takes, again, strict=True):
        for name in ("observation.state", "action", "next.reward", "next.done", "next.truncated"):
            np.testing.assert_array_equal(mine.readings[name].values, theirs.readings[name].values)


def test_flat_pictures_are_lazy_and_right(tmp_path):
    d4rl_file(tmp_path / "carla.hdf5", True, False, picture=True)
    with h5py.File(tmp_path / "carla.hdf5") as file:
        here, after = file["observations"][()], file["next_observations"][()]
    takes = list(hdf5.read(tmp_path / "carla.hdf5").takes())
    assert [len(take.readings["action"].values) for take in takes] == [4, 6]
    values = takes[1].readings["observation.images.rgb"].values
    np.testing.assert_array_equal(np.stack(list(values)), np.concatenate([here[4:], after[-1:]]))


@pytest.mark.parametrize("padded", [True, False])
def test_rows_of_jpeg_files_are_pictures(tmp_path, padded):
    """As ALOHA keeps them: of one length, padded with zeros; or each of its own length."""
    rng = np.random.default_rng(0)
    truth = np.repeat(np.repeat(rng.integers(0, 255, (5, 3, 4, 3), dtype=np.uint8), 16, 1), 16, 2)
    files = [simplejpeg.encode_jpeg(np.ascontiguousarray(one), 95, colorspace="RGB") for one in truth]
    assert len({len(one) for one in files}) > 1
    with h5py.File(tmp_path / "episode_0.hdf5", "w") as file:
        file["action"], file["observations/qpos"] = np.zeros((5, 14), np.float32), np.zeros((5, 14), np.float32)
        if padded:
            length = max(map(len, files))
            rows_ = np.stack([np.frombuffer(one.ljust(length, b"\0"), np.uint8) for one in files])
            file["observations/images/cam_high"] = rows_
            file["compress_len"] = np.array([[len(one) for one in files]])
        else:
            kept = file.create_dataset("observations/images/cam_high", (5,), h5py.vlen_dtype(np.uint8))
            for at, one in enumerate(files):
                kept[at] = np.frombuffer(one, np.uint8)
        file["observations/tactile"] = np.full((5, 400), 255, np.uint8)
    source = hdf5.read(tmp_path / "episode_0.hdf5", fps=50)
    (name,) = (name for name in source.sensors if name.endswith("cam_high"))
    assert source.sensors[name].kind == "image" and source.sensors[name].shape == (48, 64, 3)
    (take,) = source.takes()
    seen = stacked(take.readings[name]).astype(int)
    assert seen.shape == truth.shape and np.abs(seen - truth).mean() < 4
    assert any("JPEG" in note and "cam_high" in note for note in source.notes)
    (tactile,) = (sensor for name, sensor in source.sensors.items() if "tactile" in name)
    assert tactile.shape == (400,), "numbers stay numbers"


def test_flat_arrays_of_other_lengths_are_refused(tmp_path):
    d4rl_file(tmp_path / "a.hdf5")
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        del file["rewards"]
        file["rewards"] = np.zeros(9)
    with pytest.raises(DatasetError, match="rewards. .* has 9 rows where 10 are needed"):
        hdf5.read(tmp_path / "a.hdf5")


# -- any layout


def test_unknown_layouts_say_what_was_found(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["banana"], file["cherry/stone"] = np.zeros(3), np.zeros(3)
    with pytest.raises(DatasetError, match="none of the known layouts .* it holds banana, cherry"):
        hdf5.read(tmp_path / "a.hdf5")
    (tmp_path / "a.hdf5").write_bytes(b"not HDF5")
    with pytest.raises(DatasetError, match="truncated or no HDF5"):
        hdf5.read(tmp_path / "a.hdf5")
    with pytest.raises(DatasetError, match="does not exist"):
        hdf5.read(tmp_path / "b.hdf5")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="no HDF5 files"):
        hdf5.read(tmp_path / "empty")


def test_links_out_of_the_file_are_not_followed(tmp_path):
    d4rl_file(tmp_path / "secret.hdf5")
    np.arange(10, dtype="f4").tofile(tmp_path / "secret.raw")
    for link in ("external", "soft", "raw", "virtual"):
        d4rl_file(tmp_path / "a.hdf5")
        with h5py.File(tmp_path / "a.hdf5", "a") as file:
            del file["rewards"]
            if link == "external":
                file["rewards"] = h5py.ExternalLink(str(tmp_path / "secret.hdf5"), "/rewards")
            elif link == "soft":
                file["rewards"] = h5py.SoftLink("/actions")
            elif link == "raw":
                file.create_dataset("rewards", (10,), "f4", external=[(str(tmp_path / "secret.raw"), 0, 40)])
            else:
                layout = h5py.VirtualLayout((10,), "f4")
                layout[:] = h5py.VirtualSource(str(tmp_path / "secret.hdf5"), "rewards", (10,))
                file.create_virtual_dataset("rewards", layout)
        with pytest.raises(DatasetError, match="rewards (is a link|keeps its values in other files)"):
            hdf5.read(tmp_path / "a.hdf5")


def test_claims_of_a_thousand_million_rows_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for name, width in (("observations", 2), ("actions", 3)):
            file.create_dataset(name, (10**9, width), "f4", chunks=(1000, width))
    with pytest.raises(DatasetError, match="claims 12000000000 bytes"):
        hdf5.read(tmp_path / "a.hdf5")


def test_truncation_is_an_error_or_the_right_shape(tmp_path):
    robomimic_file(tmp_path / "a.hdf5")
    whole = (tmp_path / "a.hdf5").read_bytes()
    errors = 0
    for cut in np.linspace(0, len(whole) - 1, 80).astype(int).tolist():
        (tmp_path / "a.hdf5").write_bytes(whole[:cut])
        try:
            source = hdf5.read(tmp_path / "a.hdf5")
            for take in source.takes():
                assert all(v.shape == source.sensors[n].shape for n, r in take.readings.items() for v in r.values)
        except DatasetError:
            errors += 1
    assert errors == 80


def test_flipped_bytes_are_an_error_or_the_right_shape(tmp_path):
    robomimic_file(tmp_path / "a.hdf5", (("demo_0", 2),))
    whole, rng, errors = (tmp_path / "a.hdf5").read_bytes(), np.random.default_rng(0), 0
    for at in rng.integers(0, 6000, 80).tolist():  # the first bytes hold most of the file's structure
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "a.hdf5").write_bytes(data)
        try:
            source = hdf5.read(tmp_path / "a.hdf5")
            for take in source.takes():
                assert all(v.shape == source.sensors[n].shape for n, r in take.readings.items() for v in r.values)
        except DatasetError:
            errors += 1
    assert 0 < errors < 80


def test_without_h5py_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    monkeypatch.delitem(sys.modules, "terrella.exchange.formats.hdf5_file")
    with pytest.raises(DatasetError, match=r"pip install 'terrella\[hdf5\]'"):
        importlib.import_module("terrella.exchange.formats.hdf5_file")


def test_a_reward_that_is_one_number_is_robomimics_flat_array(tmp_path):
    assert robomimic._place(Sensor("observation.depth", "depth", (2, 2))) == ("obs", "rgb_depth")
    sensors = {n: Sensor(n, "vector", (1,), "float64") for n in ("action", "next.reward")}
    take = Take({n: Readings(np.arange(2.0), np.ones((2, 1))) for n in sensors})
    robomimic.write(Source("s", sensors, lambda: iter([take]), 1.0), tmp_path / "a.hdf5")
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data/demo_0/rewards"].shape == (2,) and file["data/demo_0/actions"].shape == (2, 1)
        assert file["data"].attrs["total"] == 2 and file["data/demo_0"].attrs["num_samples"] == 2
    (found,) = hdf5.read(tmp_path / "a.hdf5").takes()
    assert rows.rows_of(found, "it").steps == 2


def test_arrays_beside_the_observations_of_a_demo_are_kept_or_named(tmp_path):
    """As LIBERO's robot_states."""
    path = robomimic_file(tmp_path / "a.hdf5", next_obs=False)
    with h5py.File(path, "a") as file:
        for name, n in (("demo_10", 4), ("demo_2", 3)):
            file[f"data/{name}/robot_states"], file[f"data/{name}/seed"] = np.arange(2.0 * n).reshape(n, 2), np.zeros(1)
    source = hdf5.read(path)
    assert [take.readings["info.robot_states"].values[-1].tolist() for take in source.takes()] == [[4, 5], [6, 7]]
    assert "info.seed" not in source.sensors and any("'seed' is left out" in note for note in source.notes)
