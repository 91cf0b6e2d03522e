"""Recording under load: a 640x480 camera at 30 frames/s beside a 128-pixel world as fast as it goes, into two folders.

    python benchmarks/recording.py [--seconds 20] [--steps-per-s 0]

Prints rows and frames recorded, how far behind the encoders and the camera were (every 200 frames an episode is committed:
a camera that cannot wait needs a queue as long as it is late), and counts in the files that they hold every frame.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from terrella.data import Dataset, Layout, Recorder, Sensor
from terrella.data.channels import ACTION, DEPTH, DONE, POSE_NAMES, REWARD, RGB, STATE
from terrella.data.storage.films import read_packets


def _layout(fps: float, actions: int, *seen: Sensor) -> Layout:
    pose = Sensor(STATE, "vector", (7,), names=POSE_NAMES)
    follow = Sensor(ACTION, "vector", (actions,)), Sensor(REWARD, "vector", (1,)), Sensor(DONE, "vector", (1,), "bool")
    return Layout(fps, {sensor.name: sensor for sensor in (*seen, pose, *follow)})


def camera(root: Path, seconds: float, facts: dict) -> None:
    """A camera with a pose, paced by the clock; late frames are counted."""
    layout = _layout(30, 2, Sensor(RGB, "image", (480, 640, 3), "uint8"))
    scene, late = pictures(480, 640), []
    began = time.perf_counter()
    with Recorder(root, layout) as recorder:
        for i in range(int(seconds * 30)):
            wait = began + i / 30 - time.perf_counter()
            if wait > 0:
                time.sleep(wait)
            late.append(-wait)
            recorder.add({"rgb": scene[i % len(scene)], "pose": np.zeros(7)}, [0.0, float(i)])
            if i % 200 == 199:  # an episode is committed while the camera goes on
                recorder.end_episode()
    missed = sum(seconds_late > 1 / 30 for seconds_late in late)
    facts["camera"] = told(recorder, int(seconds * 30))
    facts["camera"] |= {"most late (s)": round(max(late), 3), "frames a period late or more": missed}


def world(root: Path, seconds: float, rate: float, facts: dict) -> None:
    """A world of 128 pixels with depth and pose, as fast as the recorder takes it (or at `rate` steps a second)."""
    layout = _layout(35, 6, Sensor(RGB, "image", (128, 128, 3), "uint8"), Sensor(DEPTH, "depth", (64, 64)))
    scene, depth, count = pictures(128, 128), np.full((64, 64), 3.0, np.float32), 0
    began = time.perf_counter()
    with Recorder(root, layout) as recorder:
        while time.perf_counter() - began < seconds:
            if rate and count / rate > time.perf_counter() - began:
                time.sleep(0.0005)
                continue
            recorder.add({"rgb": scene[count % len(scene)], "depth": depth, "pose": np.zeros(7)}, [0.0] * 6)
            count += 1
            if count % 1000 == 999:
                recorder.end_episode()
        took = time.perf_counter() - began
    facts["world"] = {"steps/s": round(count / took)} | told(recorder, count)


def pictures(height: int, width: int) -> list[np.ndarray]:
    """A textured scene that pans, as a camera sees one; 64 frames that return to the first."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (height // 16, width // 16, 3)).repeat(16, 0).repeat(16, 1)
    base = (0.8 * coarse + rng.integers(0, 50, (height, width, 3))).astype(np.uint8)
    return [np.roll(base, 2 * min(i, 64 - i), 1) for i in range(64)]


def told(recorder: Recorder, given: int) -> dict:
    """What the folder holds against what was given, counted in the files themselves."""
    dataset = Dataset(recorder.root)
    films = sum(
        read_packets(dataset.files.local(e.videos[dataset.rgb_key].file), dataset.fps).count for e in dataset.episodes
    )
    pressure = recorder.pressure
    return {
        "given": given,
        "rows kept": dataset.length,
        "frames kept": films,
        "dropped": given - films,
        "waited for the encoder (s)": round(pressure.waited_s, 3),
        "most frames waiting": pressure.most_waiting,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--steps-per-s", type=float, default=0.0, help="pace of the world; 0 goes as fast as it can")
    asked, facts = parser.parse_args(), {}
    with tempfile.TemporaryDirectory() as folder:
        jobs = [
            threading.Thread(target=camera, args=(Path(folder) / "camera", asked.seconds, facts)),
            threading.Thread(target=world, args=(Path(folder) / "world", asked.seconds, asked.steps_per_s, facts)),
        ]
        for job in jobs:
            job.start()
        for job in jobs:
            job.join()
    print(json.dumps(facts, indent=1))


if __name__ == "__main__":
    main()
