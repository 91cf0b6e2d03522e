"""Reading for training: clips from the cache, building it, opening long recordings; beside LeRobot's loader if asked.

    python benchmarks/data.py --lerobot ~/lerobot/bin/python

`--lerobot` is the python of another environment that has lerobot 0.4 (tests/data/test_lerobot.py says how to make it).
Both read the same clips of the same recording, in turns; everything lies in a temporary folder and is warm.
benchmarks/recording.py times recording.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from terrella.data import ClipCache, Layout, Recorder, Sensor
from terrella.data.channels import ACTION, DONE, REWARD, RGB
from terrella.data.training.cache import finish_cache, new_arrays
from terrella.data.training.clips import Clips, ClipsConfig

LENGTH, BATCH, FPS = 16, 32, 30

OPEN = """
import json, resource, sys, time
from terrella.data import ClipCache, Dataset
from terrella.data.training.clips import Clips, ClipsConfig
def anonymous_mib():
    return int(next(line for line in open("/proc/self/status") if line.startswith("RssAnon")).split()[1]) / 1024
root, warm = sys.argv[1:]
list(Clips(ClipCache.open(warm), ClipsConfig(4, ("action",), 4)))
before = anonymous_mib()
begun = time.perf_counter()
dataset = Dataset(root)
dataset_s = time.perf_counter() - begun
dataset.episode(len(dataset.episodes) // 2, ["action"])
dataset_row_s = time.perf_counter() - begun - dataset_s
dataset_mib = anonymous_mib() - before
cache = ClipCache.open(dataset)
before = anonymous_mib()
begun = time.perf_counter()
clips = Clips(ClipCache(cache.path), ClipsConfig(16, ("action", "row"), 32))
next(iter(clips))
clips_s = time.perf_counter() - begun
for count, batch in enumerate(clips.forever()):
    if count == 2000:
        break
print(json.dumps({
    "dataset_s": dataset_s, "episode_s": dataset_row_s, "dataset_mib": dataset_mib,
    "clips_s": clips_s, "clips_mib": anonymous_mib() - before,
}))
"""

OURS = """
import json, sys, time
import numpy as np
from terrella.data.training.clips import Clips, ClipsConfig
root, length, batch, workers, count, size, keep, as_float = sys.argv[1:]
length, batch, workers, count, size = int(length), int(batch), int(workers), int(count), json.loads(size)
clips = Clips(root, ClipsConfig(length, ("rgb", "action", "row"), batch, size, workers=workers, torch=True, seed=1))
batches = clips.forever()
first = next(batches)
pictures = first["rgb"].float()
begun = time.perf_counter()
for _ in range(count):
    one = next(batches)
    if as_float == "1":
        pictures.copy_(one["rgb"]).mul_(1 / 255)
took = time.perf_counter() - begun
again = Clips(root, ClipsConfig(length, ("rgb", "row"), batch, size, seed=1))
rows = [b["row"][:, 0].tolist() for b, _ in zip(again.forever(), range(count + 1))]
np.savez(keep, rows=np.concatenate(rows), rgb=first["rgb"].numpy())
print(json.dumps({"frames_per_s": count * batch * length / took}))
"""

# torchvision's compiled operators may be missing beside a CPU torch; lerobot does not call them.
LEROBOT = """
import json, sys, time
import numpy as np, torch
try:
    import torchvision
except RuntimeError:
    for module in [name for name in sys.modules if name.startswith("torchvision")]:
        del sys.modules[module]
    library = torch.library.Library("torchvision", "DEF")
    library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
from lerobot.datasets.lerobot_dataset import LeRobotDataset
root, length, batch, workers, count, fps, keep = sys.argv[1:]
length, batch, workers, count = int(length), int(batch), int(workers), int(count)
known = np.load(keep)
later = [i / float(fps) for i in range(length)]
data = LeRobotDataset("local/it", root=root, delta_timestamps={"observation.images.rgb": later, "action": later})
loader = torch.utils.data.DataLoader(data, batch_size=batch, sampler=known["rows"].tolist(), num_workers=workers)
batches = iter(loader)
first = next(batches)["observation.images.rgb"]
begun = time.perf_counter()
for _ in range(count):
    next(batches)
took = time.perf_counter() - begun
theirs = (first.permute(0, 1, 3, 4, 2) * 255).round().numpy()
off = float(np.abs(theirs - known["rgb"].astype(np.float32)).mean())
print(json.dumps({"frames_per_s": count * batch * length / took, "off": off, "decoder": data.video_backend}))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", type=Path, help="a python that has lerobot 0.4, to be timed in the same run")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each; the median counts")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of lines")
    options = parser.parse_args()
    result: dict = {"cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()}
    with tempfile.TemporaryDirectory(prefix="terrella-data-") as folder:
        result["reading"] = reading(Path(folder), options.rounds)
        result["building"] = building(Path(folder))
        result["opening"] = opening(Path(folder))
        if options.lerobot:
            result["beside_lerobot"] = beside_lerobot(Path(folder), options.lerobot.expanduser(), options.rounds)
    print(json.dumps(result, indent=1) if options.json else report(result))


def reading(folder: Path, rounds: int) -> list[dict]:
    """Clips of pictures and actions from a cache that lies in memory, with 1 and 2 threads."""
    found = []
    for pixels, rows in ((64, 32_000), (128, 12_000)):
        cache = noise(folder / f"noise-{pixels}", pixels, rows)
        speed: dict[int, list[float]] = {1: [], 2: []}
        for _, workers in itertools.product(range(rounds), speed):
            batches = Clips(cache, ClipsConfig(LENGTH, ("rgb", "action"), BATCH, workers=workers)).forever()
            for _ in range(rows // (LENGTH * BATCH)):  # every page of the cache is mapped
                next(batches)
            count, begun = 0, time.perf_counter()
            while time.perf_counter() - begun < 1.5:
                next(batches)
                count += 1
            speed[workers].append(count * BATCH * LENGTH / (time.perf_counter() - begun))
            batches.close()
        found += [{"pixels": pixels, "workers": n, "frames_per_s": statistics.median(s)} for n, s in speed.items()]
    return found


def noise(folder: Path, pixels: int, rows: int) -> ClipCache:
    folder.mkdir()
    (folder / "staged").mkdir()
    kinds = {"rgb": (np.dtype(np.uint8), (pixels, pixels, 3)), "action": (np.dtype(np.float32), (6,))}
    arrays = new_arrays(folder / "staged", kinds, rows)
    for at in range(0, rows, 1000):
        arrays["rgb"][at : at + 1000] = np.random.default_rng(at).integers(0, 256, (1, pixels, pixels, 3), np.uint8)
    starts = np.arange(0, rows, 500)
    finish_cache(folder / "staged", folder / "cache", arrays, np.stack([starts, starts + 500], 1), FPS)
    return ClipCache(folder / "cache")


def building(folder: Path) -> list[dict]:
    """Frames a second that the cache is built with on one core, from our own H.264."""
    found = []
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    for (height, width), size in (((128, 128), (128, 128)), ((128, 128), (64, 64)), ((192, 256), (96, 128))):
        root = folder / f"filmed-{height}x{width}"
        if not root.exists():
            film(root, height, width, 4_000)
        if cores:
            os.sched_setaffinity(0, {min(cores)})
        begun, worked = time.perf_counter(), time.process_time()
        ClipCache.open(root, size)
        took, worked = time.perf_counter() - begun, time.process_time() - worked
        if cores:
            os.sched_setaffinity(0, cores)
        about = {"from": [height, width], "to": list(size)}
        found.append(about | {"frames_per_s": 4_000 / took, "frames_per_cpu_s": 4_000 / worked})
    return found


def film(root: Path, height: int, width: int, frames: int) -> None:
    """A recording in which a textured scene pans, in episodes of 500 rows."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (height // 16, width // 16, 3)).repeat(16, 0).repeat(16, 1)
    scene = (0.8 * coarse + rng.integers(0, 50, (height, width, 3))).astype(np.uint8)
    with Recorder(root, _layout(6, Sensor(RGB, "image", (height, width, 3), "uint8"))) as recorder:
        for i in range(frames):
            recorder.add({"rgb": np.roll(scene, (i // 3, 2 * i), (0, 1))}, [float(i % 2)] * 6)
            if i % 500 == 499:
                recorder.end_episode()


def opening(folder: Path) -> list[dict]:
    """What it takes to open recordings of more and more rows and to read at random from them, each in a new process."""
    found = []
    for rows in (10_000, 100_000, 1_000_000):
        synthesised(folder / f"rows-{rows}", rows)
        found.append({"rows": rows, **run(sys.executable, OPEN, folder / f"rows-{rows}", folder / "rows-10000")})
    return found


def _layout(actions: int, *seen: Sensor) -> Layout:
    follow = Sensor(ACTION, "vector", (actions,)), Sensor(REWARD, "vector", (1,)), Sensor(DONE, "vector", (1,), "bool")
    return Layout(FPS, {sensor.name: sensor for sensor in (*seen, *follow)})


def synthesised(root: Path, rows: int, of_episode: int = 1000) -> None:
    """A recording of actions alone, as LeRobot packs one: all episodes in one file."""
    layout = _layout(2)
    features = {key: value for key, value in layout.features().items() if key.split(".")[0] in ("action", "index")}
    episodes = np.arange(rows // of_episode)
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "features": features,
        "total_frames": rows,
        "total_episodes": len(episodes),
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    }
    (root / "data" / "chunk-000").mkdir(parents=True)
    (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    flat = pa.array(np.random.default_rng(0).random(2 * rows, np.float32))
    table = pa.table({"index": np.arange(rows), "action": pa.FixedSizeListArray.from_arrays(flat, 2)})
    pq.write_table(table, root / "data" / "chunk-000" / "file-000.parquet", row_group_size=of_episode)
    nothing = np.zeros(len(episodes), np.int64)
    about = {
        "episode_index": episodes,
        "data/chunk_index": nothing,
        "data/file_index": nothing,
        "dataset_from_index": episodes * of_episode,
        "dataset_to_index": (episodes + 1) * of_episode,
        "tasks": pa.array([["go"]] * len(episodes)),
    }
    pq.write_table(pa.table(about), root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")


def beside_lerobot(folder: Path, python: Path, rounds: int) -> dict:
    """The same clips of the same recording through both loaders, in turns."""
    found = {}
    for height, width in ((128, 128), (192, 256)):
        root, keep = folder / f"filmed-{height}x{width}", folder / "clips.npz"
        ClipCache.open(root, (height, width))
        size = json.dumps([height, width])
        speed: dict[str, list[dict]] = {"ours": [], "ours_float": [], "theirs": []}
        for _ in range(rounds):
            for name, as_float in (("ours", 0), ("ours_float", 1)):
                speed[name].append(run(sys.executable, OURS, root, LENGTH, BATCH, 2, 60, size, keep, as_float))
            speed["theirs"].append(run(python, LEROBOT, root, LENGTH, BATCH, 2, 8, FPS, keep))
        middle = {name: statistics.median(one["frames_per_s"] for one in some) for name, some in speed.items()}
        found[f"{height}x{width}"] = middle | {
            "times_faster": middle["ours"] / middle["theirs"],
            "times_faster_as_float": middle["ours_float"] / middle["theirs"],
            "mean_difference_of_255": max(one["off"] for one in speed["theirs"]),
            "decoder": speed["theirs"][0]["decoder"],
        }
    return found


def run(python: str | Path, program: str, *arguments) -> dict:
    environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
    command = [str(python), "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        sys.exit(f"a timing failed:\n{done.stderr}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def report(result: dict) -> str:
    lines = [f"clips of {LENGTH} in batches of {BATCH}, {result['cores']} cores"]
    for one in result["reading"]:
        clips = one["frames_per_s"] / LENGTH
        lines.append(
            f"  from the cache, {one['pixels']:>3} px, {one['workers']} workers   "
            f"{one['frames_per_s']:>9,.0f} frames/s {clips:>8,.0f} clips/s"
        )
    for one in result["building"]:
        (h, w), (height, width) = one["from"], one["to"]
        lines.append(
            f"  building, {h}x{w} to {height}x{width}   {one['frames_per_s']:,.0f} frames/s on one core, "
            f"{one['frames_per_cpu_s']:,.0f} per second of its own time"
        )
    first = result["opening"][0]
    for one in result["opening"]:
        lines.append(
            f"  opening {one['rows']:>9,} rows   dataset {one['dataset_s']:.3f} s, an episode {one['episode_s']:.3f} s, "
            f"{one['dataset_mib']:.1f} MiB; clips {one['clips_s']:.3f} s (x{one['clips_s'] / first['clips_s']:.1f}), "
            f"{one['clips_mib']:.1f} MiB after 2,000 batches"
        )
    for size, one in result.get("beside_lerobot", {}).items():
        lines.append(
            f"  beside LeRobot ({one['decoder']}), {size}   {one['ours']:,.0f} : {one['theirs']:,.0f} frames/s, "
            f"x{one['times_faster']:.0f}; as float32 x{one['times_faster_as_float']:.0f}; "
            f"pictures differ by {one['mean_difference_of_255']:.2f} of 255"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
