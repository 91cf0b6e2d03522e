"""Small made-up robots whose every number is a function of time, for the tests of merging."""

from __future__ import annotations

import numpy as np

from terrella.data.source import Lazy, Readings, Sensor, Source, Take


def robot(
    name: str,
    sensors: list[Sensor],
    takes: list[dict[str, tuple[np.ndarray, object]]],
    fps: float | None = 10.0,
    tasks: tuple[str, ...] = (),
) -> Source:
    """A source whose takes are given as sensor -> (times, values)."""

    def read():
        for number, readings in enumerate(takes):
            task = tasks[number] if tasks else f"{name} does {number}"
            rows = {key: Readings(np.asarray(time_s, np.float64), values) for key, (time_s, values) in readings.items()}
            yield Take(rows, task, start_ns=1_000_000_000 * number, facts={"success": True})

    return Source(name, {sensor.name: sensor for sensor in sensors}, read, fps=fps, robot=name)


def arm(name="arm", fps=10.0, rows=(6, 9), unit="rad", scale=1.0, size=(8, 12), seed=0, terminal=True) -> Source:
    """Two joints and a gripper; a front camera; rewards; T observations and T - 1 actions (T where not `terminal`)."""
    rng = np.random.default_rng(seed)
    names, units = ("shoulder", "elbow", "gripper"), {"shoulder": unit, "elbow": unit, "gripper": "0..1"}
    sensors = [
        Sensor("observation.images.front", "image", (*size, 3), "uint8", facts={"calibration": {"K": [1, 2, 3]}}),
        Sensor("observation.state", "vector", (3,), "float32", names, units, frame="base"),
        Sensor("action", "vector", (3,), "float32", names, units, frame="base"),
        Sensor("next.reward", "vector", (1,), "float32"),
        Sensor("next.done", "vector", (1,), "bool"),
    ]
    takes = []
    for count in rows:
        time_s, acted = np.arange(count) / fps, count - terminal
        pictures = rng.integers(0, 256, (count, *size, 3), dtype=np.uint8)
        takes.append(
            {
                "observation.images.front": (time_s, Lazy(count, pictures.__getitem__)),
                "observation.state": (time_s, (rng.normal(size=(count, 3)) * scale).astype(np.float32)),
                "action": (time_s[:acted], (rng.normal(size=(acted, 3)) * scale).astype(np.float32)),
                "next.reward": (time_s[:acted], rng.integers(0, 9, (acted, 1)).astype(np.float32)),
                "next.done": (time_s[:acted], np.arange(acted)[:, None] == acted - 1),
            }
        )
    return robot(name, sensors, takes, fps)


def rover(name="rover", seconds=1.0, seed=1) -> Source:
    """Sensors with clocks of their own: a steady pose at 25 Hz, an IMU at 100, a camera at 10, LiDAR at 5, depth at 10."""
    rng = np.random.default_rng(seed)
    pose = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    sensors = [
        Sensor("observation.images.mast", "image", (6, 6, 3), "uint8", rate_hz=10),
        Sensor("observation.depth", "depth", (3, 4), rate_hz=10),
        Sensor("observation.points.lidar", "points", (0, 4), names=("x", "y", "z", "intensity"), rate_hz=5),
        Sensor("observation.state", "vector", (7,), "float64", pose, frame="world", rate_hz=25),
        Sensor("observation.imu", "vector", (2,), "float32", ("ax", "wz"), {"ax": "g", "wz": "deg/s"}, rate_hz=100),
        Sensor("action", "vector", (2,), "float32", rate_hz=25),
    ]
    clock = {hz: np.arange(int(seconds * hz) + 1) / hz for hz in (5, 10, 25, 100)}
    t = clock[25]
    still = np.zeros_like(t)
    state = np.stack([2 * t, -t, still, np.cos(t / 4), still, still, np.sin(t / 4)], 1)
    scans = [rng.normal(size=(rng.integers(0, 9), 4)).astype(np.float32) for _ in clock[5]]
    take = {
        "observation.images.mast": (clock[10], rng.integers(0, 256, (len(clock[10]), 6, 6, 3), dtype=np.uint8)),
        "observation.depth": (clock[10], rng.uniform(1, 9, (len(clock[10]), 3, 4)).astype(np.float32)),
        "observation.points.lidar": (clock[5], scans),
        "observation.state": (t, state),
        "observation.imu": (clock[100], np.stack([clock[100], 90 * clock[100]], 1).astype(np.float32)),
        "action": (t[:-1], rng.normal(size=(len(t) - 1, 2)).astype(np.float32)),
    }
    return robot(name, sensors, [take, take], fps=None)
