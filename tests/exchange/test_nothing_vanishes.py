"""What goes in comes out, or is named, in every command that reads what others made. Odd inputs are counted thing by thing."""

from __future__ import annotations

import json
import shutil
import string
from collections.abc import Callable
from pathlib import Path

import av
import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces
from PIL import Image

from terrella.cli import main
from terrella.data import Dataset, Readings, Sensor, Source, Take
from terrella.exchange import write_source

Things = dict[str, str]  # a thing of the input -> the word by which the output or a note is known to hold it
RNG = np.random.default_rng(0)
PICTURES = RNG.integers(0, 256, (8, 32, 48, 3), np.uint8)
NUMBERS, WORDS = RNG.normal(size=(8, 2)).astype(np.float32), np.arange(8).astype(str)
STEPS = {"observations": NUMBERS, "actions": NUMBERS[:, :1]}


def flat_npz(folder: Path) -> tuple[Path, Things]:
    more = {
        "terminals": np.arange(8) == 3, "qpos": NUMBERS, "eye": PICTURES, "gamma": np.array(0.9), "names": np.array(["x", "y"]),
        "observations/said": WORDS, "mission": np.full(8, "find the cup"), "infos": np.array([{}] * 8, object), "goal": NUMBERS[:3],
    }  # fmt: skip
    np.savez(folder / "a.npz", **STEPS, **more)
    here = {"qpos": "info.qpos", "eye": "images.eye", "mission": "find the cup", "terminals": "next.done"}
    return folder / "a.npz", here | {name: f"'{name}'" for name in ("gamma", "names", "infos", "goal")} | {
        "said": "said"
    }


def folder_of_npz(folder: Path) -> tuple[Path, Things]:
    np.savez(folder / "0.npz", **STEPS)
    np.savez(folder / "1.npz", obs=NUMBERS, actions=NUMBERS[:, :1], rewards=NUMBERS[:, 0], extra=NUMBERS)
    (folder / "inner").mkdir()
    np.savez(folder / "inner" / "2.npz", **STEPS)
    (folder / "labels.csv").write_text("a,b")
    return folder, {
        "obs": "observation.",
        "rewards": "next.reward",
        "extra": "info.extra",
        "2": "inner/2.npz",
        "labels": "labels.csv",
    }


def robomimic_file(folder: Path) -> tuple[Path, Things]:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "a.hdf5", "w") as file:
        for number in range(2):
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"], demo["obs/arm/pos"] = NUMBERS, NUMBERS
            demo["obs/text"] = [f"line {row}" for row in range(8)]
        demo["obs/force"], demo["next_obs/force"], demo["obs/empty"] = NUMBERS, NUMBERS, np.zeros((8, 0))
        demo["obs/lang"] = ["wave"] * 8
        file["data/stray"], file["index"] = np.zeros(3), np.zeros(3)
    known = {
        "pos": "observation.arm",
        "force": "observation.force",
        "lang": "wave",
        "empty": "empty",
        "text": "obs/text",
    }
    return folder / "a.hdf5", {**known, "stray": "data/stray", "index": "'index'", "next_obs": "next_obs"}


def flat_hdf5(folder: Path) -> tuple[Path, Things]:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "a.hdf5", "w") as file:
        for name, values in {**STEPS, "terminals": np.arange(8) == 3, "infos/qvel": NUMBERS}.items():
            file[name] = values
        file["metadata/policy/weight"], file["metadata/algorithm"] = np.zeros((2, 2)), "SAC"
        file["success"], file["notes"], file["short"] = np.ones(8), ["a", "b"], np.zeros(3)
        file["pairs"] = np.zeros(8, [("left", "f4"), ("right", "f4")])
    things = {
        "qvel": "info.qvel",
        "weight": "policy/weight",
        "success": "info.success",
        "notes": "notes",
        "short": "short",
    }
    return folder / "a.hdf5", {**things, "left": "pairs.left", "right": "pairs.right"}


def minari_set(folder: Path) -> tuple[Path, Things]:
    h5py = pytest.importorskip("h5py")
    box = {"type": "Box", "dtype": "float32", "shape": [2], "low": [-9.0, -9.0], "high": [9.0, 9.0]}
    parts = {"body": box, "graph": {"type": "Graph"}, "many": {"type": "Sequence"}, "mission": {"type": "Text"}}
    meta = {"total_episodes": 2, "observation_space": {"type": "Dict", "subspaces": parts}, "action_space": box}
    (folder / "data").mkdir()
    (folder / "data" / "metadata.json").write_text(json.dumps(meta))
    with h5py.File(folder / "data" / "main_data.hdf5", "w") as file:
        for number in range(2):
            episode = file.create_group(f"episode_{number}")
            episode["observations/body"], episode["actions"] = NUMBERS, NUMBERS[:7]
            episode["observations/mission"] = ["lift"] * 8
            for name in ("rewards", "terminations", "truncations"):
                episode[name] = np.zeros(7)
        episode["infos/late"], episode["infos/text"] = np.ones(8), ["a"] * 8
    things = {"body": "observation.body", "graph": "graph", "many": "many", "mission": "lift"}
    return folder, {**things, "late": "info.late", "text": "infos/text"}


def film_folder(folder: Path) -> tuple[Path, Things]:
    for name in ("a.mkv", "b.mkv"):
        with av.open(str(folder / name), "w") as container:
            cover = container.add_stream("mjpeg", rate=10)
            film, tone = container.add_stream("libx264", rate=10), container.add_stream("pcm_s16le", rate=8000)
            for stream, (height, width), form in ((cover, (40, 40), "yuvj420p"), (film, (32, 48), "yuv420p")):
                stream.height, stream.width, stream.pix_fmt = height, width, form
            square = av.VideoFrame.from_ndarray(
                PICTURES[0, :, :32].repeat(2, 0)[:40].repeat(2, 1)[:, :40], format="rgb24"
            )
            container.mux([*cover.encode(square), *cover.encode()])
            for picture in PICTURES:
                container.mux(film.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            quiet = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
            quiet.rate = 8000
            container.mux([*film.encode(), *tone.encode(quiet), *tone.encode()])
    (folder / "a.srt").write_text("hello")
    (folder / "x" / "y").mkdir(parents=True)
    shutil.copy(folder / "a.mkv", folder / "x" / "y" / "deep.mkv")
    return folder, {"films": "images.rgb", "cover": "40 x 40", "sound": "sound", "words": "a.srt", "deep": "deep.mkv"}


def image_folder(folder: Path) -> tuple[Path, Things]:
    for row, picture in enumerate(PICTURES):
        Image.fromarray(picture).convert("RGBA").save(folder / f"{row}.png")
    frames = [Image.fromarray(picture) for picture in PICTURES[:3]]
    frames[0].save(folder / "8.tiff", save_all=True, append_images=frames[1:])
    (folder / "poses.txt").write_text("0 0 0")
    return folder, {"images": "images.rgb", "alpha": "transparency", "frames": "several frames", "poses": "poses.txt"}


def robot_log(folder: Path) -> tuple[Path, Things]:
    writer_of = pytest.importorskip("mcap.writer")
    topics = {
        "/arm": ("my.State", {"x": 1.0, "tag": "cup"}),
        "/log": ("foxglove.Log", {"message": "hi"}),
        "/scan": ("my.Ros", {}),
    }
    with open(folder / "a.mcap", "wb") as file:
        writer = writer_of.Writer(file)
        writer.start()
        for topic, (name, _) in topics.items():
            number = writer.register_schema(name, "jsonschema", b"{}")
            channel = writer.register_channel(topic, "cdr" if topic == "/scan" else "json", number)
            for row in range(8):
                fields = json.dumps(topics[topic][1]).encode()
                writer.add_message(channel, row * 10**8, fields, row * 10**8)
        writer.add_attachment(0, 0, "arm.urdf", "text/xml", b"<robot/>")
        writer.add_metadata("weather", {"sky": "grey"})
        writer.finish()
    return folder / "a.mcap", {
        "x": "observation.arm",
        "tag": "tag",
        "log": "/log",
        "scan": "/scan",
        "urdf": "arm.urdf",
        "sky": "weather",
    }


class Odd(gymnasium.Env):
    """Observations with parts of every kind."""

    metadata = {"render_modes": [], "render_fps": 10}
    observation_space = spaces.Dict(
        {
            "arm": spaces.Dict({"pos": spaces.Box(-9, 9, (2,), np.float32), "mode": spaces.Discrete(3)}),
            "pair": spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(3))),
            "crowd": spaces.Sequence(spaces.Discrete(2)),
            "mission": spaces.Text(20, charset=string.printable),
            "sign": spaces.Text(20, charset=string.printable),
        }
    )
    action_space = spaces.Discrete(2)

    def _seen(self):
        arm = {"pos": np.full(2, self.step_count / 9, np.float32), "mode": self.step_count % 3}
        sign = f"row {self.step_count}"
        return {"arm": arm, "pair": (1, np.ones(3, np.int8)), "crowd": (0,), "mission": "find the key", "sign": sign}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_count = 0
        return self._seen(), {"secret": 1}

    def step(self, action):
        self.step_count += 1
        return self._seen(), 0.0, False, self.step_count == 7, {}


ODD = {
    "pos": "arm.pos",
    "mode": "arm.mode",
    "left": "pair.0",
    "right": "pair.1",
    "crowd": "crowd",
    "mission": "find the key",
    "sign": "sign",
}


def environment(folder: Path) -> tuple[str, Things]:
    if "Odd-v0" not in gymnasium.registry:
        gymnasium.register("Odd-v0", entry_point=Odd)
    return "gym:Odd-v0", {**ODD, "secret": "secret"}


def foreign_lerobot(folder: Path) -> tuple[Path, Things]:
    names = {"observation.state": NUMBERS, "action": NUMBERS, "observation.images.front": PICTURES}
    sensors = {
        name: Sensor(name, "image" if it.ndim == 4 else "vector", it.shape[1:], it.dtype.name)
        for name, it in names.items()
    }
    take = Take({name: Readings(np.arange(8) / 10, it) for name, it in names.items()})
    write_source(Source("set", sensors, lambda: [take], 10.0), folder / "set")
    table = folder / "set" / "data" / "chunk-000" / "file-000.parquet"
    pq.write_table(pq.read_table(table).append_column("observation.force", pa.array(NUMBERS[:, 0])), table)
    shutil.copytree(folder / "set/videos/observation.images.front", folder / "set/videos/observation.images.wrist")
    (folder / "set" / "calibration.yaml").write_text("f: 1")
    things = {"force": "observation.force", "wrist": "images.wrist", "yaml": "calibration.yaml"}
    return folder / "set", {**things, "front": "images.front", "state": "observation.state"}


def shooter_file(folder: Path) -> tuple[Path, Things]:
    h5py = pytest.importorskip("h5py")
    for name, parts in {"a.hdf5": ("x", "y"), "b.hdf5": ("x", "y", "helperarr", "sound")}.items():
        with h5py.File(folder / name, "w") as file:
            for row in range(8):
                values = {"x": PICTURES[row], "y": np.eye(51)[row], "helperarr": np.zeros(2), "sound": np.zeros(5)}
                for part in parts:
                    file[f"frame_{row}_{part}"] = values[part]
    return folder, {"x": "images.rgb", "y": "action", "helperarr": "observation.events", "sound": "sound"}


INPUTS: list[Callable] = [
    flat_npz, folder_of_npz, robomimic_file, flat_hdf5, minari_set, film_folder, image_folder, robot_log, environment,
    foreign_lerobot, shooter_file,
]  # fmt: skip


def account(things: Things, outcome: list[str], notes: list[str]) -> tuple[set[str], set[str]]:
    """(what came out, what is named as left out or changed) of the things that went in."""
    here = {thing for thing, word in things.items() if any(word in name for name in outcome)}
    return here, {thing for thing, word in things.items() if any(word in note for note in notes)}


@pytest.mark.parametrize("made", INPUTS, ids=lambda made: made.__name__)
def test_convert_gives_or_names_every_thing(tmp_path, capsys, made):
    (tmp_path / "in").mkdir()
    source, things = made(tmp_path / "in")
    assert main(["data", "convert", str(source), str(tmp_path / "out"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    data = Dataset(tmp_path / "out")
    here, named = account(things, [*data.features, *data.tasks], facts["left_out"])
    assert set(things) - here - named == set(), f"vanished; said: {facts['left_out']}"
    assert len(things) == len(here) + len(named - here), "each thing that went in is counted once"
    assert named - here, "the input has something odd"


def test_the_doctor_names_what_is_no_part_of_a_recording(tmp_path, capsys):
    folder, things = foreign_lerobot(tmp_path)
    assert main(["data", "doctor", str(folder), "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    said = [*facts["notes"], *(f"{fault['file']} {fault['what']}" for fault in facts["faults"])]
    here, named = account(things, list(Dataset(folder).features), said)
    assert here == {"front", "state"} and named >= {"force", "wrist", "yaml"}


def test_space_import_names_what_no_place_holds(tmp_path, capsys):
    names = ("x", "y", "z", "nx", "label", "confidence")
    header = ["ply", "format ascii 1.0", "element vertex 40", *(f"property float {name}" for name in names)]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    points = [f"{k} {k % 7} {k % 5} 0 3 0.5 200 100 50" for k in range(39)] + ["nan 0 0 0 3 0.5 1 2 3", "3 0 1 2"]
    (tmp_path / "a.ply").write_text("\n".join([*header, *points]) + "\n")
    assert main(["space", "import", str(tmp_path / "a.ply"), "--out", str(tmp_path / "place")]) == 0
    said = "".join(capsys.readouterr())
    assert "39 Gaussians" in said, "what came out is counted"
    for word in ("nx", "label", "confidence", "1 face", "1 of its 40"):
        assert word in said, word


def test_record_gives_or_names_every_part_of_an_observation(tmp_path, capsys):
    world, _ = environment(tmp_path)
    assert main(["record", "world", world, "--frames", "30", "--out", str(tmp_path / "set")]) == 0
    said = capsys.readouterr()
    data = Dataset(tmp_path / "set")
    here, named = account(ODD, [*data.features, *data.tasks], [said.out, said.err])
    assert set(ODD) - here - named == set(), said.err
    assert {"pos", "mode", "left", "right"} <= here
