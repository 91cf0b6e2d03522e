"""Builds a town of roads around a MuJoCo car: houses, trees, kerbs, cars and walkers that a task moves, and three cameras."""

# pyright: reportAttributeAccessIssue=false

import math

import numpy as np

from .mujoco_model import mujoco
from .road_network import LANE_M, REACH_M, RoadNetwork

CARS, WALKERS = 14, 16
PAVEMENT_M = 0.3  # width
YAWS_DEG = {"front": 0.0, "left": 70.0, "right": -70.0}
FIELD_DEG, PITCH_DEG = 90.0, 7.0  # of each camera: horizontal field of view, and how far it looks down
ASPECT = 4 / 3  # of its pictures
SIGNS = (1.0, -1.0)
_AFFINITY = 2  # nothing collides with it, but LiDAR sees it
_BOX, _CAPSULE, _ELLIPSOID = (getattr(mujoco.mjtGeom, f"mjGEOM_{kind}") for kind in ("BOX", "CAPSULE", "ELLIPSOID"))
_PAINTS = (
    (0.75, 0.15, 0.12),
    (0.9, 0.9, 0.9),
    (0.12, 0.12, 0.14),
    (0.85, 0.7, 0.15),
    (0.2, 0.5, 0.3),
    (0.55, 0.57, 0.6),
)
_WALLS = (
    (0.72, 0.45, 0.35),
    (0.85, 0.78, 0.65),
    (0.6, 0.62, 0.66),
    (0.8, 0.6, 0.45),
    (0.5, 0.4, 0.42),
    (0.9, 0.88, 0.85),
)


def build_town(spec: mujoco.MjSpec, roads: RoadNetwork, seed: int) -> None:
    """Replaces the yard around the body "car" by the town. The joints of cars (x, y, heading), then of walkers (x, y) are the last
    of the model, relative to the origin."""
    rng, world = np.random.default_rng((seed, 1)), spec.worldbody
    for geom in [one for one in world.geoms if one.name != "floor"]:
        spec.delete(geom)
    for camera in list(spec.cameras):
        spec.delete(camera)
    floor = spec.geom("floor")
    floor.material, floor.rgba, floor.size = "", [0.35, 0.5, 0.28, 1], [20, 20, 1]
    spec.stat.extent, spec.stat.center = 5.0, [0, 0, 0]
    spec.visual.quality.numquads = 1  # of a face of a box: all are flat
    spec.add_material(name="dull", specular=0, shininess=0)
    sun, light = spec.worldbody.lights[0], spec.visual.headlight
    sun.dir, sun.diffuse, sun.specular = [0.5, 0.35, -0.8], [0.6] * 3, [0] * 3
    # a headlight goes with the camera: a wall would not look the same from each
    light.ambient, light.diffuse, light.specular = [0.5] * 3, [0] * 3, [0] * 3
    _pave(world, roads)
    for street in range(len(roads.streets)):
        for sign in SIGNS:
            _line_street(world, roads, street, sign, rng)
    for at in range(CARS):
        _add_car(world, f"car {at}", _PAINTS[at % len(_PAINTS)])
    for at in range(WALKERS):
        _add_walker(world, f"walker {at}", rng.uniform(0.1, 0.95, 3))
    _add_cameras(spec.body("car"))


def _decoration(body, kind, size, place, colour, **more) -> None:
    """Adds a geom without mass that nothing collides with."""
    body.add_geom(
        type=kind,
        size=size,
        pos=place,
        rgba=[*colour, 1],
        material="dull",
        mass=0,
        contype=0,
        **{"conaffinity": 0, **more},
    )


def _frame(roads: RoadNetwork, street: int) -> tuple[np.ndarray, np.ndarray, float]:
    """The middle of a street, its direction and half its length between junctions."""
    first, last = roads.nodes[roads.streets[street]]
    length = float(np.linalg.norm(last - first))
    return (first + last) / 2, (last - first) / length, length / 2 - REACH_M


def _flat(along: np.ndarray, long: float, wide: float) -> list[float]:
    """Half sizes in x and y of a box of half length `long` along a street."""
    return [long, wide] if abs(along[0]) > 0.5 else [wide, long]


def _pave(world, roads: RoadNetwork) -> None:
    """Asphalt, dashes in the middle of streets, and crossings."""
    asphalt, paint = (0.28, 0.28, 0.3), (0.85, 0.85, 0.8)
    for x0, y0, x1, y1 in roads.surface.tolist():
        _decoration(world, _BOX, [(x1 - x0) / 2, (y1 - y0) / 2, 0.004], [(x0 + x1) / 2, (y0 + y1) / 2, 0.002], asphalt)
    for street in range(len(roads.streets)):
        middle, along, half = _frame(roads, street)
        count = int(half / 0.3)
        for at in np.linspace(-half + 0.4, half - 0.4, count):
            _decoration(world, _BOX, [*_flat(along, 0.11, 0.014), 0.006], [*(middle + at * along), 0.004], paint)


def _line_street(world, roads: RoadNetwork, street: int, sign: float, rng: np.random.Generator) -> None:
    """Pavement, houses and trees on one side of a street."""
    middle, along, half = _frame(roads, street)
    aside = sign * np.array([-along[1], along[0]])

    def place(at: float, beside: float, height: float) -> list[float]:
        return [*(middle + at * along + beside * aside), height]

    edge = LANE_M + PAVEMENT_M / 2
    _decoration(world, _BOX, [*_flat(along, half, PAVEMENT_M / 2), 0.012], place(0, edge, 0.012), (0.62, 0.61, 0.58))
    at = -half
    while at < half - 0.5:
        long, deep, tall = rng.uniform([0.5, 0.5, 0.5], [1.1, 0.8, 1.8])
        long = min(long, half - at)
        shade = np.array(_WALLS[rng.integers(len(_WALLS))]) * rng.uniform(0.85, 1.1)
        if rng.random() < 0.8:
            beside = LANE_M + PAVEMENT_M + 0.12 + deep / 2
            centre = place(at + long / 2, beside, tall / 2)
            size = [*_flat(along, long / 2 - 0.04, deep / 2), tall / 2]
            _decoration(world, _BOX, size, centre, shade.clip(0, 1), conaffinity=_AFFINITY)
            centre[2] = tall + 0.03
            _decoration(world, _BOX, [size[0] + 0.02, size[1] + 0.02, 0.03], centre, (0.35, 0.2, 0.18))
        at += long + rng.uniform(0.05, 0.4)
    for at in rng.uniform(-half, half, rng.integers(0, 3)):
        height = rng.uniform(0.35, 0.6)
        _decoration(world, _CAPSULE, [0.025, height / 2, 0], place(at, edge + 0.15, height / 2), (0.35, 0.25, 0.15))
        leaves = (rng.uniform(0.1, 0.25), rng.uniform(0.4, 0.6), 0.15)
        size = [0.14, 0.14, rng.uniform(0.15, 0.25)]
        _decoration(world, _ELLIPSOID, size, place(at, edge + 0.15, height + 0.1), leaves, conaffinity=_AFFINITY)


def _moving_body(world, name: str, axes: str):
    """A body without contacts that moves along x and y, and turns about z where `axes` says so."""
    body = world.add_body(name=name, mass=1.0, inertia=[0.01] * 3, explicitinertial=True)
    for axis, kind in zip(axes, (mujoco.mjtJoint.mjJNT_SLIDE,) * 2 + (mujoco.mjtJoint.mjJNT_HINGE,)):
        direction = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}[axis]
        body.add_joint(name=f"{name} {axis}", type=kind, axis=direction)
    return body


def _add_car(world, name: str, paint: tuple[float, float, float]) -> None:
    body = _moving_body(world, name, "xyz")
    _decoration(body, _BOX, [0.2, 0.095, 0.045], [0, 0, 0.075], paint, conaffinity=_AFFINITY)
    _decoration(body, _BOX, [0.11, 0.08, 0.035], [-0.03, 0, 0.15], (0.15, 0.18, 0.22))
    for sign in SIGNS:
        _decoration(
            body, _BOX, [0.01, 0.08, 0.015], [sign * 0.2, 0, 0.085], (1, 1, 0.8) if sign > 0 else (0.8, 0.05, 0.05)
        )
        _decoration(body, _BOX, [0.05, 0.1, 0.04], [sign * 0.12, 0, 0.04], (0.06, 0.06, 0.07))


def _add_walker(world, name: str, clothes: np.ndarray) -> None:
    body = _moving_body(world, name, "xy")
    _decoration(body, _CAPSULE, [0.035, 0.06, 0], [0, 0, 0.095], clothes, conaffinity=_AFFINITY)
    _decoration(body, _ELLIPSOID, [0.026] * 3, [0, 0, 0.21], (0.85, 0.65, 0.5))


def _add_cameras(car) -> None:
    """Beside each other on the roof; each looks along its yaw."""
    pitch = math.radians(PITCH_DEG)
    for name, yaw_deg in YAWS_DEG.items():
        yaw = math.radians(yaw_deg)
        forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), -math.sin(pitch)])
        right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
        camera = car.add_camera(name=name, pos=[0.1, 0.03 * np.sign(yaw), 0.2])
        camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
        camera.alt.xyaxes = [*right, *np.cross(right, forward)]
        camera.fovy = 2 * math.degrees(math.atan(math.tan(math.radians(FIELD_DEG / 2)) / ASPECT))
