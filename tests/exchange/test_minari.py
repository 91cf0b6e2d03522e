"""Minari datasets: what the real package wrote is what we read, and what we write it loads, value for value."""

from __future__ import annotations

import io
import json

import numpy as np
import pyarrow as pa
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from terrella.core.errors import DatasetError
from terrella.data.source import Readings, Sensor, Source, Take
from terrella.exchange.formats import environments
from terrella.exchange.formats import minari as ours

h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'terrella[hdf5]'")
minari = pytest.importorskip("minari", reason="minari is not installed: pip install 'minari[hdf5,arrow]'")
from minari.data_collector import EpisodeBuffer  # noqa: E402

FORMATS = ("hdf5", "arrow", "parquet")
pytestmark = pytest.mark.filterwarnings("ignore:.*:UserWarning:minari.*")

OBSERVATION = spaces.Dict(
    {
        "camera": spaces.Box(0, 255, (40, 36, 3), np.uint8),
        "agent": spaces.Dict({"pos": spaces.Box(-np.inf, np.inf, (2, 2), np.float64), "key": spaces.Discrete(5)}),
        "pair": spaces.Tuple((spaces.MultiBinary(3), spaces.Box(np.float32([0, -1]), np.float32([1, np.inf])))),
        "mission": spaces.Text(40),
    }
)
ACTION = spaces.Tuple((spaces.Discrete(3), spaces.MultiDiscrete([2, 7])))


def episode(steps: int, seed: int) -> dict:
    rng = np.random.default_rng(seed)
    n = steps + 1
    return {
        "observations": {
            "camera": rng.integers(0, 256, (n, 40, 36, 3), np.uint8),
            "agent": {"pos": rng.normal(size=(n, 2, 2)), "key": rng.integers(0, 5, n)},
            "pair": (rng.integers(0, 2, (n, 3), np.int8), rng.random((n, 2), np.float32)),
            "mission": [f"reach cup {seed}"] * n,
        },
        "actions": (rng.integers(0, 3, steps), rng.integers(0, 2, (steps, 2))),
        "rewards": rng.normal(size=steps),
        "terminations": np.arange(steps) == steps - 1,
        "truncations": np.zeros(steps, bool),
        "infos": {"qpos": rng.normal(size=(n, 3)), "deep": {"count": np.arange(n)}},
    }


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "store"))
    return tmp_path / "store"


def made(store, kind: str, jpeg: bool = False, name: str = "arm/test-v0", episodes=((5, 1), (3, 2))) -> list[dict]:
    """A dataset that the real package wrote, and its episodes."""
    given = [episode(steps, seed) for steps, seed in episodes]
    minari.create_dataset_from_buffers(
        name,
        [EpisodeBuffer(seed=seed, **data) for data, (_, seed) in zip(given, episodes)],
        observation_space=OBSERVATION,
        action_space=ACTION,
        data_format=kind,
        jpeg_encoding=jpeg,
        author="somebody",
    )
    return given


def stacked(readings: Readings) -> np.ndarray:
    return np.stack(list(readings.values))


def flat(data: dict) -> dict[str, np.ndarray]:
    """Sensor -> values [n, ...], as an episode's arrays should be read."""
    observations, actions = data["observations"], data["actions"]
    n, steps = len(observations["camera"]), len(data["rewards"])
    return {
        "observation.images.camera": observations["camera"],
        "observation.agent.pos": observations["agent"]["pos"].reshape(n, 4),
        "observation.agent.key": observations["agent"]["key"].reshape(n, 1),
        "observation.pair.0": observations["pair"][0],
        "observation.pair.1": observations["pair"][1],
        "action.0": actions[0].reshape(steps, 1),
        "action.1": actions[1],
        "next.reward": data["rewards"].reshape(steps, 1),
        "next.done": data["terminations"].reshape(steps, 1),
        "next.truncated": data["truncations"].reshape(steps, 1),
        "info.qpos": data["infos"]["qpos"],
        "info.deep.count": data["infos"]["deep"]["count"].reshape(n, 1),
    }


def check(source: Source, given: list[dict]) -> None:
    takes = list(source.takes())
    assert len(takes) == len(given)
    for take, data in zip(takes, given):
        truth = flat(data)
        assert set(take.readings) == set(source.sensors) == set(truth)
        for name, values in truth.items():
            found = stacked(take.readings[name])
            assert (found.dtype, source.sensors[name].dtype) == (values.dtype, values.dtype.name)
            np.testing.assert_array_equal(found, values)
            assert found.shape[1:] == source.sensors[name].shape
            np.testing.assert_allclose(take.readings[name].time_s, np.arange(len(values)) / source.fps)
        assert take.task == data["observations"]["mission"][0]


@pytest.mark.parametrize("kind", FORMATS)
def test_what_minari_wrote_is_what_we_read(store, kind):
    given = made(store, kind)
    source = ours.read(store / "arm" / "test-v0")
    check(source, given)
    assert source.name == "arm/test-v0" and source.facts["minari"]["author"] == ["somebody"]
    assert source.fps == 10 and "1/10 s" in source.notes[0] and ours.read(store / "arm/test-v0", fps=4).fps == 4
    assert [take.facts["minari"]["seed"] for take in source.takes()] == [1, 2]
    pos = source.sensors["observation.agent.pos"]
    assert pos.kind == "vector" and pos.shape == (4,) and source.sensors["observation.images.camera"].kind == "image"


@pytest.mark.parametrize("kind", FORMATS)
def test_what_we_write_minari_loads_and_it_is_the_same(store, kind):
    given = made(store, kind)
    assert ours.write(ours.read(store / "arm/test-v0"), store / "copy-v3") == []
    dataset = minari.load_dataset("copy-v3")
    truth = minari.load_dataset("arm/test-v0")
    assert dataset.observation_space == truth.observation_space and dataset.action_space == truth.action_space
    assert (dataset.total_episodes, dataset.total_steps, dataset.id) == (2, 8, "copy-v3")
    for mine, theirs, data in zip(dataset.iterate_episodes(), truth.iterate_episodes(), given, strict=True):
        for one, other in ((mine, theirs), (mine, data)):
            tree_equal(one.observations, other["observations"] if isinstance(other, dict) else other.observations)
            tree_equal(one.actions, other["actions"] if isinstance(other, dict) else other.actions)
        for name in ("rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(mine, name), data[name])
            assert getattr(mine, name).dtype == data[name].dtype
        np.testing.assert_array_equal(mine.infos["qpos"], data["infos"]["qpos"])
        np.testing.assert_array_equal(mine.infos["deep"]["count"], data["infos"]["deep"]["count"])
    seeds = [meta["seed"] for meta in dataset.storage.get_episode_metadata([0, 1])]
    assert seeds == [1, 2] and set(minari.list_local_datasets()) == {"arm/test-v0", "copy-v3"}
    check(ours.read(store / "copy-v3"), given)


def tree_equal(one, other) -> None:
    if isinstance(other, dict):
        assert set(one) == set(other)
        for key in other:
            tree_equal(one[key], other[key])
    elif isinstance(other, tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other):
            tree_equal(a, b)
    elif isinstance(other, list):
        assert list(one) == other
    else:
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("kind", FORMATS)
def test_jpeg_pictures_are_decoded_when_looked_at(store, kind, monkeypatch):
    made(store, kind, jpeg=True)
    truth = [e.observations["camera"] for e in minari.load_dataset("arm/test-v0").iterate_episodes()]
    decoded = []
    original = Image.open
    monkeypatch.setattr(Image, "open", lambda *a, **k: (decoded.append(1), original(*a, **k))[1])
    for take, camera in zip(ours.read(store / "arm/test-v0").takes(), truth, strict=True):
        decoded.clear()
        values = take.readings["observation.images.camera"].values
        np.testing.assert_array_equal(values[2], camera[2])
        assert len(decoded) == 1
        np.testing.assert_array_equal(np.stack(list(values)), camera)


def test_an_environments_rollouts_are_a_minari_dataset(store):
    source = environments.from_env("CartPole-v1", episodes=3)
    ours.write(source, store / "cartpole-v0")
    dataset = minari.load_dataset("cartpole-v0")
    assert dataset.action_space == spaces.Discrete(2)
    for mine, take in zip(dataset.iterate_episodes(), source.takes(), strict=True):
        np.testing.assert_array_equal(mine.observations, take.readings["observation.state"].values)
        np.testing.assert_array_equal(mine.actions, take.readings["action"].values[:, 0])
        assert mine.actions.shape == (len(mine.observations) - 1,)
    assert ours.read(store / "cartpole-v0").fps == 50


@settings(max_examples=15)
@given(
    state=hnp.arrays(np.float32, (4, 3), elements=st.floats(allow_nan=False, width=32)),
    count=hnp.arrays(np.uint64, (4, 2)),
    flags=hnp.arrays(np.bool_, (4, 2)),
    picture=hnp.arrays(np.uint8, (4, 3, 5, 3)),
    reward=hnp.arrays(np.float32, (3, 1), elements=st.floats(allow_nan=False, width=32)),
    task=st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
)
def test_write_read_write_is_the_identity(tmp_path_factory, state, count, flags, picture, reward, task):
    folder = tmp_path_factory.mktemp("m")
    sensors = {
        s.name: s
        for s in (
            Sensor("observation.state", "vector", (3,), "float32", ("x", "y", "z"), {"x": "m"}, "world"),
            Sensor("observation.images.front", "image", (3, 5, 3), "uint8", rate_hz=8.0),
            Sensor("observation.depth", "depth", (3, 5), "float32"),
            Sensor("observation.flags", "vector", (2,), "bool"),
            Sensor("action", "vector", (2,), "uint64", ("left", "right")),
            Sensor("next.reward", "vector", (1,), "float32"),
            Sensor("next.done", "vector", (1,), "bool"),
            Sensor("next.truncated", "vector", (1,), "bool"),
            Sensor("info.seen", "vector", (2,), "bool"),
            Sensor("info.seen.twice", "vector", (2,), "bool"),
        )
    }
    depth = np.where(picture[..., 0] > 9, np.float32(picture[..., 1]), np.float32(np.inf))
    values = {"observation.state": state, "observation.images.front": picture, "observation.depth": depth,
              "observation.flags": flags, "action": count[:3], "next.reward": reward, "next.done": flags[:3, :1],
              "next.truncated": flags[:3, 1:], "info.seen": flags, "info.seen.twice": ~flags}  # fmt: skip
    take = Take({n: Readings(np.arange(len(v)) / 8, v) for n, v in values.items()}, task, 1234567890123456789)
    source = Source("made", sensors, lambda: iter([take, take]), 8.0, "arm", facts={"x": [1]})
    assert ours.write(source, folder / "a-v0") == []
    first = ours.read(folder / "a-v0")
    ours.write(first, folder / "b-v0")
    for found in (first, ours.read(folder / "b-v0")):
        assert (found.fps, found.robot, found.name, found.facts["x"]) == (8.0, "arm", "made", [1])
        for name, sensor in sensors.items():
            mine = found.sensors[name]
            assert (mine.names, mine.units, mine.frame) == (sensor.names, sensor.units, sensor.frame)
            assert (mine.kind, mine.shape, mine.dtype, mine.rate_hz) == (
                sensor.kind,
                sensor.shape,
                sensor.dtype,
                sensor.rate_hz,
            )
        for again in found.takes():
            assert (again.task, again.start_ns) == (task, take.start_ns)
            for name, value in values.items():
                assert stacked(again.readings[name]).dtype == value.dtype
                np.testing.assert_array_equal(stacked(again.readings[name]), value)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        for theirs in minari.load_dataset("b-v0").iterate_episodes():
            np.testing.assert_array_equal(theirs.observations["images.front"], picture)
            np.testing.assert_array_equal(theirs.observations["state"], state)
            np.testing.assert_array_equal(theirs.actions, count[:3])


def plain(**changes) -> Source:
    values = {
        "observation.state": np.ones((4, 2)),
        "action": np.ones((4, 1)),
        "next.done": np.eye(4, dtype=bool)[:, -1:],
    }
    values = {name: value for name, value in {**values, **changes}.items() if value is not None}
    sensors = {n: Sensor(n, "vector", v.shape[1:], v.dtype.name) for n, v in values.items()}
    take = Take({n: Readings(np.arange(len(v), dtype=float), v) for n, v in values.items()})
    return Source("s", sensors, lambda: iter([take]), 1.0)


def test_an_action_without_an_observation_after_it_is_left_out_and_said(store):
    notes = ours.write(plain(lidar=np.ones((9, 1))), store / "a-v0")
    assert [any(word in note for note in notes) for word in ("last action was left out", "rewards", "'lidar'")] == [
        True
    ] * 3
    (found,) = minari.load_dataset("a-v0").iterate_episodes()
    assert found.observations.shape == (4, 2) and found.actions.shape == (3, 1) and found.rewards.tolist() == [0, 0, 0]
    assert found.truncations.tolist() == [False, False, True] and not found.terminations.any()


def test_what_minari_cannot_hold_is_refused_and_nothing_is_left_behind(store):
    store.mkdir()
    for source, name, match in [
        (plain(action=None), "a-v0", "no actions"),
        (plain(**{"observation.state": None}), "a-v0", "no observations"),
        (plain(), "a", "no Minari id"),
        (plain(**{"observation.state": np.ones((9, 2))}), "a-v0", "9 observations and 4 actions"),
        (plain(**{"observation.b": np.ones((3, 1))}), "a-v0", "different rates"),
        (plain(**{n: np.ones((1, 1)) for n in ("observation.state", "action", "next.done")}), "a-v0", "2 or more"),
        (Source("s", plain().sensors, lambda: iter([]), 1.0), "a-v0", "no takes"),
    ]:
        with pytest.raises(DatasetError, match=match):
            ours.write(source, store / name)
    assert list(store.iterdir()) == []
    ours.write(plain(), store / "a-v0")
    assert minari.load_dataset("a-v0").total_steps == 3
    with pytest.raises(DatasetError, match="exists already"):
        ours.write(plain(), store / "a-v0")


def test_texts_that_change_are_kept(store):
    data = episode(3, 0)
    data["observations"]["mission"] = ["go", "go", "stop", "go"]
    minari.create_dataset_from_buffers(
        "a-v0", [EpisodeBuffer(**data)], observation_space=OBSERVATION, action_space=ACTION, data_format="hdf5"
    )
    source = ours.read(store / "a-v0")
    (take,) = source.takes()
    assert take.task == "" and take.facts["texts"] == {"observations/mission": ["go", "go", "stop", "go"]}
    ours.write(source, store / "b-v0")
    assert next(minari.load_dataset("b-v0").iterate_episodes()).observations["mission"] == ["go", "go", "stop", "go"]


@pytest.mark.parametrize("kind", FORMATS)
def test_broken_datasets_are_named(store, kind):
    made(store, kind)
    data = store / "arm" / "test-v0" / "data"
    meta = json.loads((data / "metadata.json").read_text())

    def told(**changes):
        (data / "metadata.json").write_text(json.dumps({**meta, **changes}))

    for changes, match in [
        ({"data_format": "lance"}, "'lance'"),
        ({"total_episodes": "many"}, "many episodes"),
        ({"observation_space": None}, "no observation_space"),
        ({"observation_space": "{"}, "observation_space .* damaged"),
        ({"observation_space": json.dumps({"type": "Graph"})}, "Graph"),
        (
            {"observation_space": json.dumps({"type": "Box", "shape": [1 << 40], "dtype": "float32"})},
            "array of numbers",
        ),
        ({"observation_space": json.dumps({"type": "Box", "shape": [-1], "dtype": "int8"})}, "-1"),
        ({"total_episodes": 3}, "episode_2|/2 has no"),
    ]:
        told(**changes)
        with pytest.raises(DatasetError, match=match):
            list(ours.read(data).takes())
    told()
    files = sorted(p for p in data.rglob("*") if p.suffix in (".hdf5", ".arrow", ".parquet"))
    whole = files[0].read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 1):
        files[0].write_bytes(whole[:cut])
        with pytest.raises(DatasetError, match="restore"):
            list(ours.read(data).takes())
    files[0].unlink()
    with pytest.raises(DatasetError):
        list(ours.read(data).takes())
    (data / "metadata.json").unlink()
    with pytest.raises(DatasetError, match="not a Minari dataset"):
        ours.read(data)


@pytest.mark.parametrize("kind", ("arrow", "parquet"))
def test_flipped_bytes_are_an_error_or_the_right_shape(store, kind):
    made(store, kind, episodes=((3, 1),))
    (file,) = (store / "arm/test-v0/data").rglob(f"*.{kind}")
    whole, rng, errors = file.read_bytes(), np.random.default_rng(0), 0
    where = np.concatenate([rng.integers(0, len(whole), 30), len(whole) - 1 - rng.integers(0, 1500, 60)])
    for at in where.tolist():
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        file.write_bytes(data)
        try:
            source = ours.read(store / "arm/test-v0")
            for take in source.takes():
                assert all(v.shape == source.sensors[n].shape for n, r in take.readings.items() for v in r.values)
        except DatasetError:
            errors += 1
    assert 0 < errors < len(where)


def test_a_jpeg_of_another_size_is_refused(store):
    made(store, "arrow", jpeg=True, episodes=((2, 1),))
    (file,) = (store / "arm/test-v0/data").rglob("*.arrow")
    table = pa.ipc.open_file(str(file)).read_all()
    seen = table.column("observations").combine_chunks()
    bomb = io.BytesIO()
    Image.new("L", (9000, 8000)).save(bomb, "JPEG")
    arrays = [seen.field(i) for i in range(seen.type.num_fields)]
    at = seen.type.get_field_index("camera")
    arrays[at] = pa.array([bomb.getvalue()] * len(seen), seen.type.field(at).type)
    fake = pa.StructArray.from_arrays(arrays, fields=list(seen.type))
    table = table.set_column(table.column_names.index("observations"), "observations", fake)
    with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    (take,) = ours.read(store / "arm/test-v0").takes()
    with pytest.raises(DatasetError, match=r"\[8000, 9000, 1\] where the space says \[40, 36, 3\]"):
        take.readings["observation.images.camera"].values[0]
