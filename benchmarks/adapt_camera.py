"""`terrella adapt` to another camera, of a world of frames alone: beside a world trained from scratch on ten times as much.

    python benchmarks/adapt_camera.py --out runs/camera          # records, trains, adapts; what stands there is not made again

A ball is pushed by forces in a box with a block in it. The other camera is turned, farther away, and sees other colours.
Errors are squared errors of frames under recorded actions on held-out episodes, as a share of copying the last frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

import terrella
from terrella.data import Layout, Recorder, Sensor
from terrella.data.channels import ACTION, DONE, REWARD, RGB
from terrella.learn.recipes.adapt import AdaptConfig
from terrella.learn.recipes.adapt_frames import frame_errors
from terrella.learn.recipes.video_config import TrainConfig
from terrella.learn.recording import Recording
from terrella.worlds.folder import load_world

SIDE, ROWS = 32, 60
V, U = 1 - 2 * (np.mgrid[0:SIDE, 0:SIDE] + 0.5) / SIDE
U = -U
BLOCK = np.array([0.4, -0.3])

ARMS = {
    "kept": "adapted, --keep", "many": "from scratch, ten times as much", "adapted": "adapted",
    "few": "from scratch, as little",
}  # fmt: skip


class Camera(NamedTuple):
    turn: np.ndarray
    zoom: float
    floor: tuple[int, int, int]
    ball: tuple[int, int, int]
    block: tuple[int, int, int]


CAMERAS = {
    "old": Camera(np.eye(2), 1.0, (30, 40, 60), (230, 180, 70), (90, 150, 90)),
    "new": Camera(np.array([[0.0, -1.0], [1.0, 0.0]]), 0.75, (70, 60, 50), (200, 90, 160), (80, 110, 190)),
}


def drawn(camera: Camera, place: np.ndarray) -> np.ndarray:
    """uint8 [SIDE, SIDE, 3]."""
    picture = np.empty((SIDE, SIDE, 3))
    picture[:] = camera.floor
    picture[np.maximum(np.abs(U), np.abs(V)) < camera.zoom] += 25
    for centre, radius, colour, square in ((BLOCK, 0.18, camera.block, True), (place, 0.16, camera.ball, False)):
        x, y = camera.zoom * (camera.turn @ centre)
        away = np.maximum(np.abs(U - x), np.abs(V - y)) if square else np.hypot(U - x, V - y)
        cover = np.clip((radius * camera.zoom - away) * SIDE / 2 + 0.5, 0, 1)[..., None]
        picture = picture * (1 - cover) + cover * np.array(colour)
    return picture.round().astype(np.uint8)


def record(folder: Path, camera: str, episodes: int, seed: int) -> Path:
    """Episodes of 6 s at 10 frames a second under random forces, each held for half a second."""
    if (folder / "meta" / "info.json").exists():
        return folder
    sensors = [Sensor(RGB, "image", (SIDE, SIDE, 3), "uint8"), Sensor(ACTION, "vector", (2,), names=("right", "up"))]
    sensors += [Sensor(REWARD, "vector", (1,)), Sensor(DONE, "vector", (1,), "bool")]
    facts = {"name": "box", "action_low": [-1.0, -1.0], "action_high": [1.0, 1.0], "dt_s": 0.1}
    rng, layout = (
        np.random.default_rng(seed),
        Layout(10.0, {one.name: one for one in sensors}, world=facts, pictures="png"),
    )
    with Recorder(folder, layout) as recorder:
        for _ in range(episodes):
            place, speed, force = rng.uniform(-0.7, 0.7, 2), np.zeros(2), np.zeros(2)
            for row in range(ROWS):
                force = rng.uniform(-1, 1, 2) if row % 5 == 0 else force
                action = None if row == ROWS - 1 else force.astype(np.float32)
                recorder.add({"rgb": drawn(CAMERAS[camera], place)}, action, 0.0, False)
                speed = np.clip(0.9 * speed + 0.06 * force, -0.3, 0.3)
                place = place + speed
                speed[np.abs(place) > 0.84] *= -0.8
                place = np.clip(place, -0.84, 0.84)
            recorder.end_episode()
    return folder


def trained(data: Path, out: Path, args: argparse.Namespace, steps: int) -> Path:
    if not (out / "world" / "world.json").exists():
        config = TrainConfig(
            size=(SIDE, SIDE),
            channels=tuple(args.channels),
            steps=steps,
            batch=8,
            uncertainty_frames=0,
            device="cpu",
            seed=args.seed,
        )
        terrella.train_video(data, out, config)
    return out


def errors(run: Path, data: Path) -> dict[str, float]:
    recording = Recording.open(data, (SIDE, SIDE), lambda *_: None, needs=("rgb", "action"), why="").require_rows()
    return frame_errors(load_world(run / "world"), recording)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/camera"))
    parser.add_argument("--steps", type=int, default=1600, help="gradient steps of the old world and from scratch")
    parser.add_argument("--adapt-steps", type=int, default=800)
    parser.add_argument("--channels", type=int, nargs=3, default=(16, 24, 32))
    parser.add_argument(
        "--episodes", type=int, default=100, help="of the old camera, and of the new one from scratch; a tenth adapts"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=list(ARMS))
    args = parser.parse_args()
    out = args.out
    old, judge_old = record(out / "old", "old", args.episodes, 0), record(out / "judge-old", "old", 20, 9)
    few, judge_new = record(out / "few", "new", args.episodes // 10, 1), record(out / "judge-new", "new", 20, 8)
    many = record(out / "many", "new", args.episodes, 2)
    worlds = {"the old camera's": trained(old, out / "run-old", args, args.steps)}
    for arm in args.arms:
        run = out / f"run-{arm}"
        if arm in ("adapted", "kept"):
            config = AdaptConfig(minutes=600, steps=args.adapt_steps, batch=8, device="cpu", seed=args.seed)
            terrella.adapt(str(out / "run-old"), few, run, config, keep=old if arm == "kept" else None)
        else:
            trained(*(few, run, args, args.adapt_steps) if arm == "few" else (many, run, args, args.steps))
        worlds[ARMS[arm]] = run
    print("| world | new camera, after 1 / 8 / 16 steps | old camera |\n| --- | --- | --- |")
    for name, run in worlds.items():
        cells = [" / ".join(f"{value:.2f}" for value in errors(run, data).values()) for data in (judge_new, judge_old)]
        print(f"| {name} | {cells[0]} | {cells[1]} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
