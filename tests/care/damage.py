"""Damages a small recording in one way after another and looks at what becomes of it; run in a process of its own.

Usage: python damage.py FOLDER CASES.json - one line of JSON before and one after each case, so that whoever reads them
sees in which case a crash or a hang happened. FOLDER holds `sound`, made by `make`.
"""

from __future__ import annotations

import hashlib
import json
import resource
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from terrella.care.doctor import examine
from terrella.care.repair import repair
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Layout, Recorder
from terrella.data.channels import ACTION, DEPTH, DONE, POSE_NAMES, REWARD, RGB, STATE
from terrella.data.source import Sensor

LIDAR, SIDE = "observation.points.lidar", "observation.images.side"
SENSORS = (
    Sensor(RGB, "image", (32, 48, 3), "uint8"),
    Sensor(DEPTH, "depth", (3, 4)),
    Sensor(STATE, "vector", (7,), names=POSE_NAMES),
    Sensor(ACTION, "vector", (2,), names=("go", "turn")),
    Sensor(REWARD, "vector", (1,)),
    Sensor(DONE, "vector", (1,), "bool"),
)
LAYOUT = Layout(
    20,
    {sensor.name: sensor for sensor in SENSORS},
    streams={LIDAR: Sensor(LIDAR, "points", (0, 3)), SIDE: Sensor(SIDE, "image", (16, 16, 3), "uint8", rate_hz=5)},
    clock=True,
)
LENGTHS = (9, 12, 10)
IN_FLIGHT = 7
KINDS = {  # what may be damaged -> the file of episode 1, or of all
    "data": "data/chunk-000/file-001.parquet",
    "video": "videos/observation.images.rgb/chunk-000/file-001.mp4",
    "stream": f"streams/{LIDAR}/chunk-000/file-001.parquet",
    "film": f"streams/{SIDE}/chunk-000/file-001.mp4",
    "times": f"streams/{SIDE}/chunk-000/file-001.parquet",
    "episodes": "meta/episodes/chunk-000/file-001.parquet",
    "tasks": "meta/tasks.parquet",
    "info": "meta/info.json",
    "stats": "meta/stats.json",
    "world": "meta/terrella.json",
    "journal": ".staging/rows.log",
    "growing": ".staging/observation.images.rgb.growing.mp4",
    "growing film": f".staging/stream-{SIDE}.growing.mp4",
}
OF_EPISODE = ("data", "video", "stream", "film", "times", "episodes")
MEMORY = 3 << 30  # bytes beyond what the imports take


def make(folder: Path) -> None:
    """FOLDER/sound: three episodes, and one in flight of a recorder that was killed."""
    with_lock = folder / "recording"
    recorder = Recorder(with_lock, LAYOUT, "patrol the hall")
    for number, length in enumerate((*LENGTHS, IN_FLIGHT)):
        for i in range(length):
            _row(recorder, number, i)
        if number < len(LENGTHS):
            recorder.end_episode()
    for video in [*recorder._videos.values(), *recorder._films.values()]:
        while video._frames.qsize():
            time.sleep(0.01)
    time.sleep(0.2)
    shutil.copytree(with_lock, folder / "sound")
    recorder.close()
    shutil.rmtree(with_lock)


def _row(recorder: Recorder, number: int, i: int) -> None:
    y, x = np.mgrid[:32, :48]
    grey = (100 + 50 * np.sin((x + 3 * i + number) / 5) + 40 * np.cos(y / 4 + i / 3)).astype(np.uint8)
    row = {"rgb": np.stack([grey, 255 - grey, grey // 2], -1), "pose": np.arange(7) + i + 10 * number}
    recorder.add({**row, "depth": np.full((3, 4), 1 + i / 10)}, [i, number], reward=i, time_s=i / 20)
    recorder.log(LIDAR, np.full((1 + i % 3, 3), i, np.float32), time_s=i / 20 + 0.01)
    if i % 4 == 0:
        recorder.log(SIDE, np.full((16, 16, 3), 10 + 9 * i, np.uint8), time_s=i / 20 + 0.02)


# -- what becomes of it ----------------------------------------------------------------------------------------------


def contents(dataset: Dataset, number: int) -> dict[str, str]:
    """A digest of every array, stream and picture of an episode."""
    found = {name: _digest(array) for name, array in dataset.episode(number).items()}
    for name in dataset.streams:
        readings = dataset.readings(number, name)
        found[name] = _digest(np.asarray(readings.time_s)) + "".join(_digest(np.asarray(v)) for v in readings.values)
    return found


def _digest(array: np.ndarray) -> str:
    return f"{array.shape}{hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=8).hexdigest()}"


def read(root: Path, truth: list[dict[str, str]]) -> list[str]:
    """Of each episode "same", "other" or "error"; ["error"] where the dataset does not open."""
    try:
        dataset = Dataset(root)
    except DatasetError:
        return ["error"]
    found = []
    for number in range(len(dataset.episodes)):
        try:
            now = contents(dataset, number)
            found.append("same" if number < len(truth) and now == truth[number] else "other")
        except DatasetError:
            found.append("error")
    return found


def mend(root: Path, out: Path, truth: list[dict[str, str]]) -> dict:
    """How many episodes the mended copy has that are as they were; DatasetError where there is nothing to mend."""
    shutil.rmtree(out, ignore_errors=True)
    try:
        repair(root, out)
    except DatasetError as error:
        return {"refused": str(error)}
    dataset = Dataset(out)
    now = [contents(dataset, number) for number in range(len(dataset.episodes))]
    faults = [fault.what for fault in examine(out).faults]
    return {
        "kept": [number for number, episode in enumerate(truth) if episode in now],
        "lengths": [episode.length for episode in dataset.episodes],
        "faults": faults,
    }


def damage(path: Path, case: dict) -> None:
    """Cuts the file at an offset, or flips the bits named."""
    raw = bytearray(path.read_bytes())
    if "cut" in case:
        path.write_bytes(raw[: case["cut"]])
    else:
        for bit in case["flip"]:
            raw[bit // 8] ^= 1 << bit % 8
        path.write_bytes(raw)


def main(folder: Path, cases: list[dict]) -> None:
    base = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (base + MEMORY, base + MEMORY))
    work, out = folder / f"work{id(cases)}", folder / f"out{id(cases)}"
    truth = [contents(Dataset(folder / "sound"), number) for number in range(len(LENGTHS))]
    shutil.copytree(folder / "sound", work)
    for at, case in enumerate(cases):
        print(json.dumps({"begin": at}), flush=True)
        path = work / KINDS[case["kind"]]
        began = time.perf_counter()
        damage(path, case)
        result: dict = {"read": read(work, truth)}
        try:
            result["faults"] = [fault.what for fault in examine(work).faults] if case.get("doctor") else None
        except DatasetError as error:
            result["faults"] = [str(error)]
        if case.get("repair"):
            result["mended"] = mend(work, out, truth)
        shutil.copyfile(folder / "sound" / KINDS[case["kind"]], path)
        result["seconds"] = time.perf_counter() - began
        result["mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        print(json.dumps({"end": at, **result}), flush=True)
    shutil.rmtree(work)
    shutil.rmtree(out, ignore_errors=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text()))
