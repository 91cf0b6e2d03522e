"""A table with three blocks, a cup and a cabinet with a drawer, before an arm: what `mujoco:table` adds to the arm's file.

The frame is the table's: x away from the arm, y to the arm's left, z up from the surface, m.
"""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .mujoco_model import FREE, compiled, mujoco

COLOURS: Mapping[str, tuple[float, float, float]] = {
    "red": (0.85, 0.12, 0.1), "green": (0.1, 0.6, 0.2), "blue": (0.12, 0.25, 0.85),
}  # fmt: skip
BLOCK_M = 0.02  # half a block's side
CUP_M, CUP_TALL_M, WALL_M = (
    0.052,
    0.036,
    0.004,
)  # half the cup's inner side, the height of its walls, and half their thickness
CABINET, DRAWER_M = (0.15, 0.17), 0.1  # where the cabinet's middle is, and how far the drawer opens
FACE_M, HANDLE_M, FIN_M = 0.085, 0.055, 0.009  # x of the cabinet's face, length of the handle, and half its thickness
HANDLE = (FACE_M - 0.75 * HANDLE_M, CABINET[1], 0.026)  # where the handle of the closed drawer is grasped
PLACED = (
    7 * (len(COLOURS) + 1) + 2
)  # the last columns of qpos: blocks and cup (7 each), the cabinet's shift, the drawer's opening
FLOOR_M = 0.7  # below the surface
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_WOOD, _DARK, _GREY = [0.76, 0.6, 0.43, 1], [0.36, 0.26, 0.2, 1], [0.92, 0.9, 0.84, 1]
_GRIP = [1.5, 0.02, 0.001]  # friction of fingers, blocks and the handle
_PARTS: tuple[tuple[str, Sequence[float], Sequence[float]], ...] = (  # of the cabinet: geoms, places and half sides
    ("cabinet", (0, 0.058, 0.03), (0.065, 0.004, 0.03)), ("cabinet", (0, -0.058, 0.03), (0.065, 0.004, 0.03)),
    ("cabinet", (0.061, 0, 0.03), (0.004, 0.054, 0.03)), ("cabinet", (0, 0, 0.058), (0.065, 0.062, 0.003)),
    ("drawer", (0.0, 0, 0.006), (0.056, 0.051, 0.003)), ("drawer", (-0.06, 0, 0.027), (0.005, 0.051, 0.024)),
    ("drawer", (0.053, 0, 0.02), (0.003, 0.051, 0.016)), ("drawer", (0, 0.048, 0.02), (0.056, 0.003, 0.016)),
    ("drawer", (0, -0.048, 0.02), (0.056, 0.003, 0.016)),
    ("handle", (FACE_M - CABINET[0] - HANDLE_M / 2, 0, 0.027), (HANDLE_M / 2, FIN_M, 0.02)),
)  # fmt: skip


@dataclass(frozen=True)
class TableArm:
    """An arm at the table."""

    base: tuple[float, float]  # x and z of its base, m
    tip: str  # site between its finger tips
    fingers: tuple[str, str]  # bodies of the fingers, which alone collide; their slides are the arm's last two joints
    pose: Mapping[
        str, float
    ]  # joint -> position at rest, rad or m: the hand points down, 0.2 m above the table, fingers along y
    grip: tuple[float, float]  # control of the gripper, its last actuator, when it is closed and open
    closed_m: float = 0.0  # gap between the fingers where both slides are at 0
    firmer: float = (
        1.0  # by how much the gripper's gains are multiplied and its pads stiffened, where the file's hold no block
    )
    adds_tip: tuple[str, tuple[float, float, float]] | None = (
        None  # body and place of the tip's site, where the file has none
    )


def table_scene(arm: TableArm) -> Callable[[mujoco.MjSpec], None]:
    """Adds the table and what is on it to the spec of an arm, and cameras: "front" looks at the arm, "wrist" at the finger tips."""

    def add(spec: mujoco.MjSpec) -> None:
        _prepare(spec, arm)
        solid = {"type": _BOX, "contype": 1, "conaffinity": 3}
        floor = next(geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE)
        floor.pos, floor.contype, floor.conaffinity = [0, 0, -FLOOR_M], 0, 0
        spec.worldbody.add_geom(
            name="table", pos=[-0.1, 0, -0.02], size=[0.5, 0.45, 0.02], rgba=_WOOD, friction=[0.8, 0.01, 0.001], **solid
        )
        for name, colour in COLOURS.items():
            block = spec.worldbody.add_body(name=name, pos=[0, 0, BLOCK_M])
            block.add_freejoint()
            block.add_geom(size=[BLOCK_M] * 3, rgba=[*colour, 1], mass=0.05, friction=_GRIP, condim=4, **solid)
        cup = spec.worldbody.add_body(name="cup", pos=[0, -0.24, WALL_M])
        cup.add_freejoint()
        half, tall = CUP_M + WALL_M, CUP_TALL_M / 2
        cup.add_geom(size=[half, half, WALL_M / 2], rgba=_GREY, mass=0.2, **solid)
        for x, y in ((half, 0), (-half, 0), (0, half), (0, -half)):
            size = [WALL_M if x else half + WALL_M, WALL_M if y else half + WALL_M, tall]
            cup.add_geom(pos=[x, y, tall], size=size, rgba=_GREY, mass=0.02, **solid)
        cabinet = spec.worldbody.add_body(name="cabinet", pos=[*CABINET, 0])
        # It stays where an episode has put it.
        cabinet.add_joint(
            name="cabinet", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0], damping=1000, frictionloss=200
        )
        drawer = cabinet.add_body(name="drawer")
        drawer.add_joint(
            name="drawer", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[-1, 0, 0], damping=4, frictionloss=1,
            limited=True, range=[0, DRAWER_M],
        )  # fmt: skip
        for part, at, size in _PARTS:
            body, colour = (
                (cabinet, _DARK) if part == "cabinet" else (drawer, _GREY if part == "handle" else [0.55, 0.4, 0.3, 1])
            )
            body.add_geom(
                pos=at, size=size, rgba=colour, mass=0.1, friction=_GRIP if part == "handle" else None, **solid
            )
        _look(spec.worldbody.add_camera(name="front", fovy=40), (0.48, -0.03, 0.58), (0.01, -0.03, 0.02))

    return add


def _prepare(spec: mujoco.MjSpec, arm: TableArm) -> None:
    """Puts the arm at the table without its weight, lets only its fingers collide, and adds a wrist camera and the tip's sensor."""
    for one in [*spec.keys, *spec.sensors, *spec.cameras, *spec.excludes]:
        spec.delete(one)
    spec.option.timestep, spec.option.cone, spec.option.impratio = 0.004, mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if arm.adds_tip is not None:
        spec.body(arm.adds_tip[0]).add_site(name=arm.tip, pos=arm.adds_tip[1])
    base = spec.worldbody.first_body()
    base.pos = [arm.base[0], 0, arm.base[1]]
    for site in spec.sites:
        site.group = 4  # which is not drawn
    touching = {geom for name in arm.fingers for geom in _geoms_below(spec.body(name))}
    for body in spec.bodies:
        body.gravcomp = 1
        for geom in body.geoms:
            if body == spec.worldbody:
                continue
            # Pads that are boxes hold better than the hull of a finger's mesh.
            solid = (
                geom in touching and bool(geom.contype or geom.conaffinity) and geom.type != mujoco.mjtGeom.mjGEOM_MESH
            )
            geom.contype, geom.conaffinity = (2, 1) if solid else (0, 0)
            if solid:
                geom.friction, geom.condim, geom.priority = _GRIP, 4, 1
                if arm.firmer > 1:
                    geom.solref, geom.solimp = [0.008, 1], [0.99, 0.995, 0.001, 0.5, 2]
    grip = list(spec.actuators)[-1]
    grip.ctrllimited, grip.ctrlrange = True, list(arm.grip)
    grip.gainprm, grip.biasprm = arm.firmer * grip.gainprm, arm.firmer * grip.biasprm
    spec.add_sensor(
        name="hand", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=arm.tip
    )
    _add_wrist_camera(spec, arm)


def _geoms_below(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    return [*body.geoms, *(geom for child in body.bodies for geom in _geoms_below(child))]


def _add_wrist_camera(spec: mujoco.MjSpec, arm: TableArm) -> None:
    """A camera at the hand that looks down at the finger tips, from the side that is turned away from the arm."""
    model = compiled(spec.copy(), "the arm")
    data = mujoco.MjData(model)
    for at in range(model.njnt):
        if model.jnt_type[at] != int(FREE):
            data.qpos[model.jnt_qposadr[at]] = arm.pose.get(model.joint(at).name, 0.0)
    mujoco.mj_kinematics(model, data)
    tip, body = data.site(arm.tip).xpos, spec.site(arm.tip).parent
    turn = data.body(body.name).xmat.reshape(3, 3).T
    place = tip + (0.075, 0, 0.11)
    axes = _axes(place, tip + (0.005, 0, -0.03))
    camera = body.add_camera(name="wrist", fovy=70, pos=turn @ (place - data.body(body.name).xpos))
    camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
    camera.alt.xyaxes = [*(turn @ axes[:3]), *(turn @ axes[3:])]


def _look(camera: mujoco.MjsCamera, place: Sequence[float], at: Sequence[float]) -> None:
    camera.pos, camera.alt.type = list(place), mujoco.mjtOrientation.mjORIENTATION_XYAXES
    camera.alt.xyaxes = list(_axes(np.asarray(place), np.asarray(at)))


def _axes(place: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The x and y axes [6] of a camera at `place` that looks at a point, upright."""
    forward = (at - place) / np.linalg.norm(at - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.concatenate([right, np.cross(right, forward)])
