"""Episodes with other sensors than the first: all are kept, who lacks what is said, and padding is known to doctor and training."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from terrella.care.doctor import examine
from terrella.core.errors import DatasetError
from terrella.data import ClipCache, Clips, ClipsConfig, Dataset, Layout, Recorder, Sensor
from terrella.exchange import open_source, write_source
from terrella.learn.recording import Recording

RGB, STATE = "observation.images.front", "observation.state"
PICTURE = np.random.default_rng(0).integers(0, 256, (9, 32, 48, 3), np.uint8)
PARTS = {  # what an episode may hold beside its observations
    "front": ("observations/front", PICTURE),
    "wrist": ("observations/wrist", PICTURE[:, ::-1]),
    "grip": ("observations/grip", np.ones((9, 2), np.float32)),
    "rewards": ("rewards", np.ones(9, np.float32)),
    "actions": ("actions", np.random.default_rng(1).normal(size=(9, 3)).astype(np.float32)),
}


def npz(folder, *episodes: str) -> None:
    """Episodes of .npz; each is named by the parts that it holds."""
    folder.mkdir()
    for number, parts in enumerate(episodes):
        state = {"observations/state": np.arange(9.0)[:, None] + number}
        np.savez(folder / f"{number}.npz", **state, **_parts(parts, number))


def _parts(parts: str, number: int) -> dict[str, np.ndarray]:
    return {key: np.roll(values, number, 0) for key, values in (PARTS[part] for part in parts.split())}


def robomimic(path, *episodes: str) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for number, parts in enumerate(episodes):
            demo = file.create_group(f"data/demo_{number}")
            demo["obs/state"] = np.arange(9.0)[:, None] + number
            for key, values in _parts(parts, number).items():
                demo[key.replace("observations/", "obs/")] = values
            demo.attrs["num_samples"] = 9


def minari(folder, *episodes: str) -> None:
    h5py = pytest.importorskip("h5py")
    (folder / "data").mkdir(parents=True)
    box = {"type": "Box", "dtype": "float32", "shape": [1], "low": [-9.0], "high": [9.0]}
    meta = {"total_episodes": len(episodes), "observation_space": box, "action_space": box}
    (folder / "data" / "metadata.json").write_text(json.dumps(meta))
    with h5py.File(folder / "data" / "main_data.hdf5", "w") as file:
        for number, parts in enumerate(episodes):
            episode = file.create_group(f"episode_{number}")
            episode["observations"], episode["actions"] = np.zeros((10, 1), "f4"), np.zeros((9, 1), "f4")
            for name in ("rewards", "terminations", "truncations"):
                episode[name] = np.zeros(9)
            for part in parts.split():
                episode[f"infos/{part}"] = np.ones(9)


WRITERS = {"a": npz, "a.hdf5": robomimic}


@pytest.mark.parametrize("name", WRITERS)
def test_all_sensors_of_all_episodes_are_kept_and_who_lacks_what_is_said(tmp_path, name):
    WRITERS[name](tmp_path / name, "front actions rewards", "wrist grip actions", "front wrist grip actions rewards")
    for to in ("lerobot", "rollouts", "robomimic", "mcap"):
        out = tmp_path / {"mcap": "out", "robomimic": "out.hdf5"}.get(to, to)
        notes = write_source(open_source(tmp_path / name, fps=10), out, to)
        for sensor, number in ((RGB, 1), ("observation.images.wrist", 0), ("observation.grip", 0), ("next.reward", 1)):
            (note,) = [note for note in notes if f"'{sensor}'" in note]
            assert f"no readings in 1 of 3 takes ({number})" in note and ("padding" in note) == (to == "lerobot")
        takes = list(open_source(out).takes())
        assert ["observation.grip" in take.readings for take in takes] == [False, True, True]
        assert [RGB in take.readings for take in takes] == [True, False, True]
        shown = takes[2].readings["observation.images.wrist"].values
        assert len(shown) == 9 and np.abs(np.asarray(shown[4], float) - PICTURE[2, ::-1]).mean() < (
            60 if to == "lerobot" else 1
        )


def test_padding_is_known_to_the_doctor_and_left_out_of_training(tmp_path):
    npz(tmp_path / "a", "front actions", "actions grip", "front grip actions", "front grip")
    write_source(open_source(tmp_path / "a", fps=10), tmp_path / "set")
    found = examine(tmp_path / "set")
    assert found.faults == []
    for name, number in ((RGB, 1), ("observation.grip", 0), ("action", 3)):
        assert any(name in note and f"in 1 of 4 episodes ({number})" in note for note in found.notes), name
    data = Dataset(tmp_path / "set")
    assert [episode.absent for episode in data.episodes] == [("observation.grip",), (RGB,), (), ("action",)]
    assert not data.episode(3)["action_valid"].any()
    figures = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    assert figures["observation.grip"]["min"] == [1, 1] and figures["observation.grip"]["count"] == [27]
    assert figures[RGB]["count"] == [27] and figures["observation.state"]["count"] == [36]
    where = {("rgb",): [0, 2, 3], ("rgb", "grip"): [2, 3], ("rgb", "action"): [0, 2], ("state",): [0, 1, 2, 3]}
    for channels, numbers in where.items():
        clips = Clips(data, ClipsConfig(4, (*channels, "episode"), 2, (16, 24), drop_last=False))
        assert sorted({int(n) for batch in clips for n in batch["episode"][:, 0]}) == numbers
        assert sorted({*numbers, *clips.padded}) == [0, 1, 2, 3]
    recording = Recording.open(data, (16, 24), lambda *given: None)
    first, stop = recording.cache.episodes[1]
    assert not recording.usable[first:stop].any() and recording.usable.any()
    few = recording.having(("grip",))
    assert [bool(few.usable[slice(*part)].any()) for part in few.cache.episodes] == [
        False,
        False,
        *few.usable[[18, 27]],
    ]
    assert few.usable.any() and len(few.held_out) == 1 and few.held_out[0] in (2, 3)
    with pytest.raises(DatasetError, match="no episode has readings of all of"):
        Clips(data, ClipsConfig(4, ("rgb", "grip", "action"), 1, (16, 24), episodes=[0, 1, 3]))
    remote = Clips(f"file://{tmp_path / 'set'}", ClipsConfig(4, ("rgb", "grip"), 1, (16, 24), cache_dir=tmp_path / "c"))
    assert remote.padded == (0, 1) and len(list(remote)) == 12


def test_statistics_are_without_padding_after_a_kill_too(tmp_path):
    layout = Layout(
        10, {name: Sensor(name, "vector", (1,)) for name in ("observation.a", "observation.b")}, pictures="png"
    )
    for number in range(3):
        with Recorder(tmp_path / "set", layout) as recorder:
            for row in range(4):
                b = None if number == 1 else np.array([5.0 + row])
                recorder.add_row({"observation.a": np.array([float(row + 9 * number)]), "observation.b": b}, row / 10)
        path = tmp_path / "set" / "meta" / "stats.json"
        figures = json.loads(path.read_text())
        assert figures["observation.b"]["min"] == [5] and figures["observation.b"]["count"] == [4 if number < 2 else 8]
        if number == 1:  # as a kill between the statistics and info.json leaves them
            path.write_text(json.dumps({name: {**it, "count": [99]} for name, it in figures.items()}))
    assert examine(tmp_path / "set").faults == []


def test_a_recording_without_gaps_keeps_its_cache(tmp_path):
    npz(tmp_path / "a", "actions", "actions")
    write_source(open_source(tmp_path / "a", fps=10), tmp_path / "set")
    assert ClipCache.open(tmp_path / "set", (16, 24)).absent == {} and examine(tmp_path / "set").notes == []


def test_a_state_that_an_episode_lacks_is_no_frozen_sensor(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "a").mkdir()
    for number in range(3):
        own = {"observations/state": rng.normal(size=(40, 2))} if number != 1 else {}
        values = {"observations/other": rng.normal(size=(40, 2)), "actions": rng.normal(size=(40, 2)), **own}
        np.savez(tmp_path / "a" / f"{number}.npz", **values)
    write_source(open_source(tmp_path / "a", fps=10), tmp_path / "set")
    assert examine(tmp_path / "set").faults == []


def test_infos_of_later_episodes_are_read(tmp_path):
    minari(tmp_path / "a-v0", "grip", "wrist", "grip wrist")
    source = open_source(tmp_path / "a-v0", fps=10)
    assert ["info.wrist" in take.readings for take in source.takes()] == [False, True, True]
    notes = write_source(source, tmp_path / "b-v0", "minari")
    assert sum("info.wrist" in note or "info.grip" in note for note in notes) == 2


def test_minari_gets_what_all_episodes_have(tmp_path):
    npz(tmp_path / "a", "actions grip", "actions front")
    notes = write_source(open_source(tmp_path / "a", fps=10), tmp_path / "b-v0", "minari")
    source = open_source(tmp_path / "b-v0")
    assert {"observation.state", "action"} <= set(source.sensors) and len(list(source.takes())) == 2
    for name in ("observation.grip", RGB):
        assert name not in source.sensors and any(
            f"'{name}' was left out: some take lacks it" in note for note in notes
        )
    npz(tmp_path / "c", "actions", "front")
    with pytest.raises(DatasetError, match="take 1 lacks 'action'"):
        write_source(open_source(tmp_path / "c", fps=10), tmp_path / "d-v0", "minari")
    assert not (tmp_path / "d-v0").exists()


def test_folders_of_pictures_may_have_other_cameras(tmp_path):
    for place in ("0/front", "0/top", "1/top", "1/side"):
        (tmp_path / "a" / place).mkdir(parents=True)
        for row in range(3):
            Image.fromarray(PICTURE[row]).save(tmp_path / "a" / place / f"{row}.png")
    notes = write_source(open_source(tmp_path / "a"), tmp_path / "set")
    assert [episode.length for episode in Dataset(tmp_path / "set").episodes] == [3, 3]
    assert any("images.side" in note for note in notes) and any("images.front" in note for note in notes)


@pytest.mark.parametrize("to", ["videos", "images"])
def test_an_episode_without_pictures_makes_no_film_and_is_named(tmp_path, to):
    npz(tmp_path / "a", "actions grip", "actions front")
    notes = write_source(open_source(tmp_path / "a", fps=10), tmp_path / "b", to)
    assert len(list(open_source(tmp_path / "b").takes())) == 1
    assert sum(f"'{RGB}' has no readings in 1 of 2 takes (0)" in note for note in notes) == 1


def test_numbers_of_another_type_are_not_cut_short(tmp_path):
    (tmp_path / "a").mkdir()
    for number, values in enumerate((np.array([1, 2, 3]), np.array([0.5, 1.5, 2.5]))):
        np.savez(tmp_path / "a" / f"{number}.npz", observations=values, actions=values)
    assert [take.readings[STATE].values.ravel().tolist() for take in open_source(tmp_path / "a").takes()] == [
        [1, 2, 3],
        [0.5, 1.5, 2.5],
    ]
    np.savez(tmp_path / "a" / "2.npz", observations=np.zeros((3, 4)), actions=np.zeros(3))
    with pytest.raises(DatasetError, match="2.npz is .4. a row where the first episode has"):
        list(open_source(tmp_path / "a").takes())
