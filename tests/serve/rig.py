"""A small robot with many sensors, each with its own clock, driving among pillars: a recording that needs no file."""

from __future__ import annotations

import numpy as np

from terrella.data.source import Lazy, Readings, Sensor, Source, Take

PILLARS = np.array(  # x, y, radius in metres, then red, green, blue; all beside the way that the robot goes
    [
        (2.6, 0.8, 0.5, 214, 84, 70),
        (-2.4, 0.6, 0.5, 70, 128, 214),
        (0.0, -1.6, 0.55, 232, 184, 84),
        (-5.0, 2.4, 0.5, 96, 190, 150),
        (5.0, 2.4, 0.5, 168, 120, 210),
        (0.2, 3.3, 0.4, 226, 226, 218),
        (-4.9, -3.3, 0.45, 222, 140, 84),
        (4.9, -3.3, 0.45, 120, 200, 220),
    ]
)
HALF = (6.4, 4.2)  # half the room's extents in metres
WALL_M, EYE_M = 2.4, 1.0
TASKS = ("drive to the red pillar", "go round the blue pillar and come back")
IMU_GAP_S = (2.0, 2.4)


def pose_at(time_s: np.ndarray, turn: float) -> np.ndarray:
    """x, y, yaw [n, 3] on a figure of eight; `turn` shifts where it begins."""
    phase = 0.55 * np.asarray(time_s) + turn
    x, y = 4.4 * np.sin(phase), 2.7 * np.sin(2 * phase + 0.5)
    yaw = np.arctan2(5.4 * np.cos(2 * phase + 0.5), 4.4 * np.cos(phase))
    return np.stack([x, y, np.unwrap(yaw)], axis=-1)


def cast(origin: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays on the ground from [2] at angles [n]: distance [n] in metres, colour [n, 3], place along the surface [n]."""
    way = np.stack([np.cos(angles), np.sin(angles)], -1)
    with np.errstate(divide="ignore"):
        reach = (np.sign(way) * HALF - origin) / way
    side = np.argmin(reach, axis=-1)
    distance = reach[np.arange(len(angles)), side]
    hit = origin + way * distance[:, None]
    along = hit[np.arange(len(angles)), 1 - side]
    wall = 2 * side + (hit[np.arange(len(angles)), side] > 0)
    colour = np.array([(150.0, 140.0, 128.0), (128.0, 138.0, 158.0), (120.0, 112.0, 122.0), (112.0, 128.0, 120.0)])[
        wall
    ]
    for x, y, radius, *own in PILLARS:
        to = np.array([x, y]) - origin
        middle, beside = way @ to, way[:, 0] * to[1] - way[:, 1] * to[0]
        inside = radius**2 - beside**2
        near = middle - np.sqrt(np.maximum(inside, 0))
        closer = (inside > 0) & (near > 0) & (near < distance)
        distance = np.where(closer, near, distance)
        light = 0.55 + 0.45 * np.sqrt(np.clip(inside, 0, None)) / radius
        colour = np.where(closer[:, None], np.array(own)[None] * light[:, None], colour)
        along = np.where(closer, np.arcsin(np.clip(beside / radius, -1, 1)) * radius, along)
    return distance, colour, along


def look(pose: np.ndarray, size: tuple[int, int], ahead: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """What a camera at x, y, yaw sees, `ahead` radians to the left: picture uint8 [H, W, 3] and depth float32 [H, W]."""
    height, width = size
    focal = 0.62 * width
    columns = (np.arange(width) - (width - 1) / 2) / focal
    distance, colour, along = cast(pose[:2], pose[2] + ahead - np.arctan(columns))
    flat = distance * np.cos(np.arctan(columns))  # along the optical axis
    rows = (np.arange(height) - (height - 1) / 2)[:, None] / focal
    top, foot = (EYE_M - WALL_M) / flat, EYE_M / flat
    wall, floor = (rows >= top) & (rows <= foot), rows > foot
    with np.errstate(divide="ignore"):
        ground = EYE_M / np.maximum(rows, 1e-9)
    depth = np.where(wall, flat[None], np.where(floor, ground, np.inf))
    angle = pose[2] + ahead
    ahead_x, ahead_y = np.cos(angle), np.sin(angle)
    x = pose[0] + ground * (ahead_x + columns * ahead_y)
    y = pose[1] + ground * (ahead_y - columns * ahead_x)
    tile = 78 + 18 * ((np.floor(x) + np.floor(y)) % 2)
    sky = np.array([26.0, 34.0, 54.0]) + 60 * np.clip(1 + 2.2 * rows, 0, 1)[..., None] * np.array([0.5, 0.7, 1.0])
    stripes = 0.86 + 0.14 * (np.sin(along * 9) > 0.0)
    lit = 1.15 / (1 + 0.07 * distance)
    seen = np.where(
        wall[..., None],
        colour * (stripes * lit)[:, None],
        np.where(floor[..., None], (tile / (1 + 0.09 * ground))[..., None] * np.array([1.0, 0.97, 0.9]), sky),
    )
    return np.clip(seen, 0, 255).astype(np.uint8), depth.astype(np.float32)


def scan(pose: np.ndarray, beams: int = 360, rings: int = 16) -> np.ndarray:
    """A LiDAR's cloud, float32 [n, 4]: x, y, z in the body's frame, and intensity."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    distance, colour, _ = cast(pose[:2], pose[2] + angles)
    tilt = np.tan(np.radians(np.linspace(-16, 15, rings)))[:, None]
    reach = np.where(tilt < 0, np.minimum(distance, EYE_M / np.maximum(-tilt, 1e-9)), distance)
    z = reach * tilt
    x, y = reach * np.cos(angles), reach * np.sin(angles)
    glow = np.where(reach < distance - 1e-6, 20.0, colour.mean(-1))
    cloud = np.stack([x, y, z, glow], -1).reshape(-1, 4)
    return cloud[cloud[:, 2] < WALL_M - EYE_M].astype(np.float32)


def lively(episodes: int = 4, seconds: float = 4.0, size: tuple[int, int] = (48, 64), beams: int = 90) -> Source:
    """Two cameras at 30 and 15 Hz, depth, a pose, an IMU at 200 Hz with a gap, a LiDAR at 10 Hz, actions and rewards."""
    pose_names = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    imu_names = ("ax", "ay", "az", "wx", "wy", "wz")
    imu_units = dict(zip(imu_names, ("m/s2",) * 3 + ("rad/s",) * 3))
    low = (size[0] // 2, size[1] // 2)
    sensors = [
        Sensor("observation.images.front", "image", (*size, 3), "uint8", rate_hz=30),
        Sensor("observation.images.left", "image", (*size, 3), "uint8", rate_hz=15),
        Sensor("observation.depth", "depth", low, rate_hz=15),
        Sensor("observation.points.lidar", "points", (0, 4), names=("x", "y", "z", "intensity"), rate_hz=10),
        Sensor("observation.state", "vector", (7,), names=pose_names, frame="world", rate_hz=30),
        Sensor("observation.imu", "vector", (6,), names=imu_names, units=imu_units, rate_hz=200),
        Sensor(
            "action", "vector", (2,), names=("forward", "turn"), units={"forward": "m/s", "turn": "rad/s"}, rate_hz=30
        ),
        Sensor("next.reward", "vector", (1,), rate_hz=30),
        Sensor("next.done", "vector", (1,), "bool", rate_hz=30),
    ]

    def take(number: int) -> Take:
        rng, turn = np.random.default_rng(number), 1.7 * number
        length = seconds * (1 + 0.5 * (number % 3))

        def clock(rate: float, jitter_s: float = 0.0) -> np.ndarray:
            steps = np.arange(int(length * rate)) / rate
            return np.sort(steps + rng.uniform(0, jitter_s, len(steps)))

        fast, slow, sweep, tick = clock(30), clock(15, 0.012), clock(10, 0.004), clock(200)
        tick = tick[(tick < IMU_GAP_S[0]) | (tick > IMU_GAP_S[1])]
        pose, at_tick = pose_at(fast, turn), pose_at(tick, turn)
        moved = np.gradient(pose, fast, axis=0)
        spin = np.gradient(at_tick[:, 2], tick)
        force = np.gradient(np.gradient(at_tick[:, :2], tick, axis=0), tick, axis=0)
        imu = np.stack([force[:, 0], force[:, 1], np.full(len(tick), 9.81), 0 * tick, 0 * tick, spin], -1)
        imu += rng.normal(0, [0.25, 0.25, 0.12, 0.02, 0.02, 0.03], imu.shape)
        half = pose[:, 2] / 2
        still = np.zeros(len(fast))
        state = np.stack([pose[:, 0], pose[:, 1], still + EYE_M, np.cos(half), still, still, np.sin(half)], -1)
        action = np.stack([np.hypot(moved[:, 0], moved[:, 1]), moved[:, 2]], -1)
        near = np.hypot(*(pose[:, :2] - PILLARS[number % 2, :2]).T)
        seen_slow, seen_sweep = pose_at(slow, turn), pose_at(sweep, turn)
        done = np.zeros((len(fast), 1), bool)
        done[-1] = True
        readings = {
            "observation.images.front": Readings(fast, Lazy(len(fast), lambda i: look(pose[i], size)[0])),
            "observation.images.left": Readings(slow, Lazy(len(slow), lambda i: look(seen_slow[i], size, 1.2)[0])),
            "observation.depth": Readings(slow, Lazy(len(slow), lambda i: look(seen_slow[i], low)[1])),
            "observation.points.lidar": Readings(sweep, Lazy(len(sweep), lambda i: scan(seen_sweep[i], beams))),
            "observation.state": Readings(fast, state.astype(np.float32)),
            "observation.imu": Readings(tick, imu.astype(np.float32)),
            "action": Readings(fast, action.astype(np.float32)),
            "next.reward": Readings(fast, np.exp(-near)[:, None].astype(np.float32)),
            "next.done": Readings(fast, done),
        }
        spoken = [
            [0.0, "leave the corner"],
            [0.4 * length, "keep left of the yellow pillar"],
            [0.75 * length, "slow down"],
        ]
        start_ns = 1_760_000_000_000_000_000 + number * 60_000_000_000
        return Take(readings, TASKS[number % 2], start_ns, {"language": spoken})

    def takes():
        return map(take, range(episodes))

    return Source("pillars", {sensor.name: sensor for sensor in sensors}, takes, robot="rover")
