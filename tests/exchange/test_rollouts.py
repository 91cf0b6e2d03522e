"""Gymnasium rollouts: what an environment did is what is read, from memory and from folders of .npz."""

from __future__ import annotations

import io
import json
import zipfile

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from terrella.core.errors import DatasetError
from terrella.data.source import Readings, Sensor, Source, Take
from terrella.exchange.formats import environments, rollouts, rows


class Arm(gymnasium.Env):
    """Counts its steps; ends after `length` of them. Its spaces have every kind of leaf."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}
    render_mode = "rgb_array"

    def __init__(self, length: int = 5):
        self.length, self.step_count = length, 0
        low, high = np.array([-1, -np.inf], np.float32), np.array([1, np.inf], np.float32)
        self.observation_space = spaces.Dict(
            {
                "camera": spaces.Box(0, 255, (40, 36, 3), np.uint8),
                "arm": spaces.Dict({"pos": spaces.Box(low, high), "grid": spaces.Box(0, 9, (2, 3), np.int16)}),
                "mission": spaces.Text(32),
                "flags": spaces.MultiBinary(4),
            }
        )
        self.action_space = spaces.Tuple((spaces.Discrete(3, start=-1), spaces.MultiDiscrete([2, 5])))

    def _seen(self):
        n = self.step_count
        return {
            "camera": np.full((40, 36, 3), n, np.uint8),
            "arm": {"pos": np.array([n / 8, -n], np.float32), "grid": np.full((2, 3), n, np.int16)},
            "mission": "reach the cup",
            "flags": np.array([n & 1, 0, 1, 1], np.int8),
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_count = 0
        return self._seen(), {}

    def step(self, action):
        self.step_count += 1
        return self._seen(), float(self.step_count), self.step_count == self.length, False, {}


def equal(one: Take, other: Take) -> None:
    assert set(one.readings) == set(other.readings)
    assert (one.task, one.start_ns) == (other.task, other.start_ns)
    for name, readings in one.readings.items():
        np.testing.assert_array_equal(readings.time_s, other.readings[name].time_s)
        mine, theirs = np.asarray(list(readings.values)), np.asarray(list(other.readings[name].values))
        assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(mine, theirs)


def test_a_rollout_keeps_the_terminal_observation_and_flattens_spaces():
    source = environments.from_env(Arm, episodes=2)
    assert {name: (s.kind, s.shape, s.dtype) for name, s in source.sensors.items()} == {
        "observation.images.camera": ("image", (40, 36, 3), "uint8"),
        "observation.arm.pos": ("vector", (2,), "float32"),
        "observation.arm.grid": ("vector", (6,), "int16"),
        "observation.flags": ("vector", (4,), "int8"),
        "action.0": ("vector", (1,), "int64"),
        "action.1": ("vector", (2,), "int64"),
        "next.reward": ("vector", (1,), "float64"),
        "next.done": ("vector", (1,), "bool"),
        "next.truncated": ("vector", (1,), "bool"),
    }
    takes = list(source.takes())
    assert source.fps == 25 and len(takes) == 2
    for take in takes:
        assert take.task == "reach the cup"
        counts = {name: len(readings.values) for name, readings in take.readings.items()}
        assert {counts[n] for n in counts if n.startswith("observation")} == {6}
        assert {counts[n] for n in counts if not n.startswith("observation")} == {5}
        np.testing.assert_array_equal(take.readings["observation.arm.pos"].values[-1], np.float32([5 / 8, -5]))
        assert take.readings["next.reward"].values.ravel().tolist() == [1, 2, 3, 4, 5]
        assert take.readings["next.done"].values.ravel().tolist() == [False] * 4 + [True]
        assert not take.readings["next.truncated"].values.any()


def test_a_registered_environment_gives_the_same_takes_at_each_call_and_others_with_another_seed():
    source = environments.from_env("CartPole-v1", episodes=3, seed=4)
    first, second = list(source.takes()), list(source.takes())
    assert source.fps == 50 and source.sensors["action"].dtype == "int64"  # CartPole's tau is 0.02 s
    for one, other in zip(first, second, strict=True):
        equal(one, other)
    other = next(iter(environments.from_env("CartPole-v1", episodes=1, seed=5).takes()))
    start = [take.readings["observation.state"].values[0].tolist() for take in (*first, other)]
    assert len({str(value) for value in start}) == 4


def test_a_long_episode_is_cut(monkeypatch):
    monkeypatch.setattr(environments, "_MAX_STEPS", 4)
    (take,) = environments.from_env("CartPole-v1", episodes=1, fps=10).takes()
    assert take.readings["next.truncated"].values.ravel().tolist() == [False] * 3 + [True]
    np.testing.assert_array_equal(take.readings["observation.state"].time_s, np.arange(5) / 10)


def test_takes_are_collected_one_by_one():
    made = []

    def make():
        made.append(Arm())
        return made[-1]

    takes = environments.from_env(make, episodes=1000).takes()
    assert next(takes).readings["action.0"].values.shape == (5, 1)
    assert made[-1].step_count == 5
    takes.close()


class Words(gymnasium.Space):
    """Texts that are no spaces.Text, as MiniGrid's missions."""

    def __init__(self):
        super().__init__(dtype=str)


class Guided(Arm):
    """An arm with a sentence under a name of its own, and with crowds of any size."""

    def __init__(self):
        super().__init__(4)
        parts = {
            "pos": self.observation_space["arm"]["pos"],
            "order": Words(),
            "crowd": spaces.Sequence(spaces.Discrete(2)),
        }
        self.observation_space = spaces.Dict(parts)

    def _seen(self):
        return {"pos": super()._seen()["arm"]["pos"], "order": "turn left", "crowd": (0,) * self.step_count}

    def step(self, action):
        return (*super().step(action)[:4], {"laps": 2})


def test_a_constant_text_is_the_task_and_what_is_no_array_is_named():
    source = environments.from_env(Guided, episodes=1)
    (take,) = source.takes()
    assert take.task == "turn left" and "texts" not in take.facts
    assert set(source.sensors) > {"observation.pos"} and sum("observations/crowd" in note for note in source.notes) == 1
    assert sum("infos of Guided are left out (" in note and "laps" in note for note in source.notes) == 1


def test_what_is_no_environment_is_said():
    with pytest.raises(DatasetError, match="NoSuchThing-v0"):
        environments.from_env("NoSuchThing-v0")
    with pytest.raises(DatasetError, match="not a Gymnasium environment"):
        environments.from_env(lambda: 3)
    with pytest.raises(DatasetError, match="0 episodes"):
        environments.from_env(Arm, episodes=0)
    env = Arm()
    env.observation_space = spaces.Sequence(spaces.Discrete(2))
    with pytest.raises(DatasetError, match="cannot be recorded"):
        environments.from_env(lambda: env)
    env = Arm()
    env.observation_space = spaces.Box(-1, 1, (7,))
    with pytest.raises(DatasetError, match="another shape"):
        next(environments.from_env(lambda: env).takes())


def test_an_environments_rollouts_survive_the_folder(tmp_path):
    source = environments.from_env(lambda: Arm(4), episodes=11)
    assert rollouts.write(source, tmp_path / "a") == []
    found = rollouts.read(tmp_path / "a")
    assert found.fps == source.fps and found.facts == source.facts and dict(found.sensors) == dict(source.sensors)
    for one, other in zip(source.takes(), found.takes(), strict=True):
        equal(one, other)
    assert [take.facts["file"] for take in found.takes()][-1] == "episode_10.npz"
    rollouts.write(found, tmp_path / "b")
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


finite = {"allow_nan": False, "width": 32}


@settings(max_examples=20)
@given(
    state=hnp.arrays(np.float32, st.tuples(st.integers(2, 6), st.integers(0, 3)), elements=st.floats(**finite)),
    count=hnp.arrays(np.int64, (6, 2)),
    flag=hnp.arrays(np.bool_, (6, 1)),
    terminal=st.booleans(),
    gaps=st.lists(st.floats(0.01, 0.011), min_size=6, max_size=6),
    task=st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
)
def test_write_read_write_is_the_identity(tmp_path_factory, state, count, flag, terminal, gaps, task):
    folder = tmp_path_factory.mktemp("r")
    n, time_s = len(state), np.cumsum(gaps)[: len(state)]
    steps = n - 1 if terminal else n
    sensors = [
        Sensor("observation.state", "vector", state.shape[1:], "float32", units={"a": "m"}, frame="world"),
        Sensor("action", "vector", (2,), "int64", names=("left", "right")),
        Sensor("next.done", "vector", (1,), "bool"),
        Sensor("info.seen", "vector", (1,), "bool", rate_hz=7.0, facts={"calibration": [1, 2]}),
    ]
    values = [state, count[:steps], flag[:steps], flag[:n]]
    made = Take({s.name: Readings(time_s[: len(v)], v) for s, v in zip(sensors, values)}, task, 1234567890123456789)
    source = Source("made", {s.name: s for s in sensors}, lambda: iter([made, made]), 100.0, "arm", facts={"x": [1]})
    assert rollouts.write(source, folder / "a") == []
    found = rollouts.read(folder / "a")
    assert (dict(found.sensors), found.fps, found.robot, found.name) == (source.sensors, 100.0, "arm", "made")
    for take in found.takes():
        equal(made, take)
    rollouts.write(found, folder / "b")
    for name in ("episode_0.npz", "episode_1.npz", "terrella.json"):
        assert (folder / "a" / name).read_bytes() == (folder / "b" / name).read_bytes()


def save(path, **arrays):
    path.parent.mkdir(exist_ok=True)
    np.savez(path, **{key.replace("__", "/"): value for key, value in arrays.items()})


@pytest.mark.parametrize(
    "keys",
    [
        {"observations": "observations", "done": "terminations", "cut": "truncations"},
        {"observations": "obs", "done": "terminated", "cut": "truncated"},
        {"observations": "obs.state", "done": "dones", "cut": "timeouts"},
    ],
)
def test_strangers_spellings_are_known(tmp_path, keys):
    obs = np.arange(12, dtype=np.float64).reshape(4, 3)
    for number in (10, 9):
        save(tmp_path / "r" / f"run{number}.npz", **{keys["observations"]: obs + number}, actions=np.array([0, 1, 2]),
             rewards=np.ones(3, np.float32), **{keys["done"]: np.array([0, 0, 1]), keys["cut"]: np.zeros(3, bool)})  # fmt: skip
    source = rollouts.read(tmp_path / "r")
    assert source.fps == 10 and "1/10 s" in source.notes[0]
    assert rollouts.read(tmp_path / "r", fps=4).notes == ()
    takes = list(source.takes())
    np.testing.assert_array_equal(takes[0].readings["observation.state"].values, obs + 9)
    assert takes[0].readings["action"].values.tolist() == [[0], [1], [2]]
    assert takes[0].readings["next.done"].values.dtype == bool
    assert takes[0].readings["next.done"].values.ravel().tolist() == [False, False, True]


def test_pictures_are_read_when_looked_at(tmp_path, monkeypatch):
    shown = np.random.default_rng(0).integers(0, 256, (4, 3, 40, 50), np.uint8)
    grey = np.random.default_rng(1).integers(0, 256, (4, 33, 34), np.uint8)
    save(tmp_path / "r" / "0.npz", observations__chw=shown, observations__grey=grey, actions=np.zeros((3, 2)))
    loaded = []
    original = rollouts._load
    monkeypatch.setattr(rollouts, "_load", lambda path, key: (loaded.append(key), original(path, key))[1])
    (take,) = rollouts.read(tmp_path / "r", fps=1).takes()
    assert loaded == ["actions"]
    found = take.readings["observation.images.chw"].values
    np.testing.assert_array_equal(found[2], shown[2].transpose(1, 2, 0))
    np.testing.assert_array_equal(take.readings["observation.images.grey"].values[3], np.stack([grey[3]] * 3, -1))
    rollouts.write(rollouts.read(tmp_path / "r", fps=1), tmp_path / "again")
    with np.load(tmp_path / "again" / "episode_0.npz") as again:
        np.testing.assert_array_equal(again["observations/images.chw"], shown)
        np.testing.assert_array_equal(again["observations/images.grey"], grey)


@pytest.mark.parametrize(
    ("shape", "dtype", "kind"),
    [((96, 64, 3), "uint8", "image"), ((84, 84), "uint8", "image"), ((1, 84, 84), "uint8", "image"),
     ((7, 7, 3), "uint8", "vector"), ((4, 84, 84), "uint8", "vector"), ((96, 64, 3), "float32", "vector")],
)  # fmt: skip
def test_bytes_the_size_of_pictures_are_pictures_and_come_back(shape, dtype, kind):
    sensor = rows.sensor_for("observation", "eye", shape, dtype)
    stored = np.random.default_rng(0).integers(0, 256, (3, *shape)).astype(dtype)
    given = rows.from_stored(stored, sensor)
    assert (
        sensor.kind == kind
        and given.shape == (3, *sensor.shape)
        and len(sensor.shape) == {"image": 3, "vector": 1}[kind]
    )
    np.testing.assert_array_equal(rows.to_stored(given, sensor), stored)


def test_bad_folders_are_named(tmp_path):
    with pytest.raises(DatasetError, match="no .npz files"):
        rollouts.read(tmp_path)
    with pytest.raises(DatasetError, match="does not exist"):
        rollouts.read(tmp_path / "none")
    one = tmp_path / "r" / "1.npz"
    good = {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1))}
    for bad, match in [
        ({"x": np.zeros(3)}, "no observations; it holds x"),
        ({"observations": np.array([{"a": 1}], object)}, "no observations"),
        ({**good, "actions": np.zeros((2, 1))}, "4 observations and 2 actions"),
        ({**good, "rewards": np.zeros(4)}, "different rates"),
        ({**good, "time_s": np.array([0, 1, np.nan, 3])}, "ascending"),
        ({**good, "time_s": np.arange(3.0)}, "3] times for 4 rows"),
        ({**good, "infos": np.zeros(9)}, "'infos' .* 9 rows"),
        ({"observations": np.zeros((0, 2))}, "0 observations"),
    ]:
        save(one, **bad)
        with pytest.raises(DatasetError, match=match):
            list(rollouts.read(tmp_path / "r").takes())
    save(one, **good)
    save(tmp_path / "r" / "2.npz", observations=np.zeros((4, 3)), actions=np.zeros((3, 1)))
    with pytest.raises(DatasetError, match=r"2\.npz is \[3\] a row where the first episode has \[2\]"):
        list(rollouts.read(tmp_path / "r").takes())
    (tmp_path / "r" / "terrella.json").write_text("[")
    with pytest.raises(DatasetError, match="terrella.json is damaged"):
        rollouts.read(tmp_path / "r")
    (tmp_path / "r" / "terrella.json").write_text(
        json.dumps({"sensors": [{"name": "a", "kind": "smell", "shape": [1]}]})
    )
    with pytest.raises(DatasetError, match="description of sensors"):
        rollouts.read(tmp_path / "r")


def test_truncation_at_every_byte_and_flipped_bytes_are_an_error_or_the_right_shape(tmp_path):
    save(tmp_path / "r" / "1.npz", observations=np.ones((4, 2), np.float32), actions=np.ones((3, 1), np.float32))
    whole, rng = (tmp_path / "r" / "1.npz").read_bytes(), np.random.default_rng(0)
    for cut in range(0, len(whole), 7):
        (tmp_path / "r" / "1.npz").write_bytes(whole[:cut])
        with pytest.raises(DatasetError):
            list(rollouts.read(tmp_path / "r").takes())
    for at in rng.integers(0, len(whole), 300).tolist():
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "r" / "1.npz").write_bytes(data)
        try:
            source = rollouts.read(tmp_path / "r")
            for take in source.takes():
                assert all(r.values[0].shape == source.sensors[n].shape for n, r in take.readings.items())
        except DatasetError:
            pass


def test_a_file_that_claims_a_thousand_million_rows_is_refused(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 2)})
    with zipfile.ZipFile(tmp_path / "1.npz", "w") as file:
        file.writestr("observations.npy", header.getvalue())
    with pytest.raises(DatasetError, match="1000000000"):
        rollouts.read(tmp_path)


def test_what_does_not_march_in_step_is_refused_and_nothing_is_left_behind(tmp_path):
    sensors = {
        name: Sensor(name, "vector", (1,), "float64") for name in ("observation.state", "observation.imu", "lidar")
    }

    def source_of(**readings) -> Source:
        take = Take({name: Readings(np.asarray(t, float), np.zeros((len(t), 1))) for name, t in readings.items()})
        return Source("s", {n: sensors[n] for n in readings}, lambda: iter([take]), 1.0)

    for readings, match in [
        ({"observation.state": [0, 1], "observation.imu": [0, 1, 2]}, "different rates"),
        ({"observation.state": [0, 1, 2], "observation.imu": [0, 1, 2.9]}, "was not read when"),
        ({"observation.state": [0, 2, 1]}, "ascending"),
        ({"lidar": [0, 1]}, "0 observations"),
    ]:
        with pytest.raises(DatasetError, match=match):
            rollouts.write(source_of(**readings), tmp_path / "out")
    with pytest.raises(DatasetError, match="no takes"):
        rollouts.write(Source("s", sensors, lambda: iter([])), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    notes = rollouts.write(source_of(**{"observation.state": [0, 1], "lidar": [0, 0.1, 0.2]}), tmp_path / "out")
    assert notes == ["'lidar' has no place in rollouts and was left out."]
