"""Rigid bodies of boxes that rest, fall and are pushed by walkers, in MuJoCo; a step is a pure function."""

# pyright: reportAttributeAccessIssue=false
# mujoco is a compiled module without declarations

import threading

import mujoco
import numpy as np
import torch
from mujoco import rollout

from .camera import rotation
from .occupancy import Walker

STEP_S = 1 / 240
DENSITY = 100.0  # kg/m^3: hollow wood
FRICTION, GRIP = 0.5, 0.2  # of things, and of the walker
WALKER_KG, PUSH_N = 75.0, 300.0
FEET_M = 0.06  # lower things do not stop the walker
REST = 0.03  # m/s and rad/s: slower things come to rest
_THINGS, _WALKER = 1, 2  # bits: walls and things meet, and things meet the walker


class RigidBodies:
    """Bodies 1 to K of boxes float32 [S, 6] (low and high corners) with `owner` [S] (0: static), and `body`, who walks among them,
    in steps of `dt_s`."""

    def __init__(self, boxes: torch.Tensor, owner: torch.Tensor, body: Walker, dt_s: float):
        self.body, self.dt_s, self.steps = body, dt_s, max(round(dt_s / STEP_S), 1)
        self.count = int(owner.max())
        self._own, self._boxes = owner, boxes
        mine = [boxes[owner == number] for number in range(1, self.count + 1)]
        middles = torch.stack([(part[:, :3].amin(0) + part[:, 3:].amax(0)) / 2 for part in mine])
        still = torch.tensor([1.0, 0, 0, 0]).expand(self.count, 4)
        self.rest = torch.cat([middles, still], 1)  # [K, 7]: poses in which their boxes lie as given
        reach = [(part.view(-1, 2, 3) - middle).norm(dim=2).amax() for part, middle in zip(mine, middles)]
        self._reach = torch.stack(reach)
        self._model = self._built(boxes.double().numpy(), owner.numpy()).compile()
        threads = torch.get_num_threads()
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool, self._lock = rollout.Rollout(nthread=threads if threads > 1 else 0), threading.Lock()

    def _built(self, boxes: np.ndarray, owner: np.ndarray) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        spec.option.timestep = self.dt_s / self.steps
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        box, slide = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtJoint.mjJNT_SLIDE
        bodies = [spec.worldbody]
        for at in self.rest.double().numpy():
            bodies.append(spec.worldbody.add_body(pos=at[:3]))
            bodies[-1].add_freejoint()
        for corners, number in zip(boxes, owner):
            middle = (corners[:3] + corners[3:]) / 2 - (self.rest[number - 1, :3].double().numpy() if number else 0)
            bits = _THINGS | _WALKER if number else _THINGS
            bodies[number].add_geom(
                type=box, size=np.maximum(corners[3:] - corners[:3], 0.002) / 2, pos=middle, density=DENSITY,
                friction=[FRICTION, 0.005, 0.0001], contype=bits, conaffinity=bits,
            )  # fmt: skip
        walker = spec.worldbody.add_body(gravcomp=1.0)
        for axis in range(3):
            joint = walker.add_joint(name="xyz"[axis], type=slide, axis=np.eye(3)[axis], armature=1e6 * (axis == 2))
            if axis < 2:
                motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
                motor.set_to_velocity(kv=2000.0)
                motor.forcelimited, motor.forcerange = True, [-PUSH_N, PUSH_N]
        tall = self.body.eye_m + self.body.head_m - FEET_M
        walker.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[self.body.radius_m, tall / 2, 0], mass=WALKER_KG,
            pos=[0, 0, FEET_M + tall / 2 - self.body.eye_m], friction=[GRIP, 0.005, 0.0001],
            contype=_WALKER, conaffinity=_WALKER,
        )  # fmt: skip
        return spec

    def step(
        self, poses: torch.Tensor, speeds: torch.Tensor, eye: torch.Tensor, goal: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Poses [B, K, 7] and speeds [B, K, 6] (m/s, rad/s) a step later, and the end [B, 3] of a walk from `eye` to `goal` [B, 3].
        Entries at rest with nobody near are not simulated."""
        near = (poses[..., :2] - goal[:, None, :2]).norm(dim=2) < self._reach + self.body.radius_m + 0.15
        level = (goal[:, None, 2] - poses[..., 2]).abs() < self._reach + self.body.eye_m + 0.2
        touched = (near & level).any(1)
        some = (touched | (speeds != 0).any(2).any(1)).nonzero()[:, 0]
        if not len(some):
            return poses, speeds, goal
        after, fast, came = self._stepped(poses[some], speeds[some], eye[some], goal[some])
        finite = after.isfinite().all(2).all(1) & fast.isfinite().all(2).all(1) & came.isfinite().all(1)
        quiet = ~touched[some] & (fast.abs() < REST).all(2).all(1)
        fast = torch.where((finite & ~quiet)[:, None, None], fast, 0.0)
        after = torch.where(finite[:, None, None], after, poses[some])
        came = torch.where((finite & touched[some])[:, None], came, goal[some])
        return poses.index_copy(0, some, after), speeds.index_copy(0, some, fast), goal.index_copy(0, some, came)

    def _stepped(self, poses, speeds, eye, goal) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        batch, count, model = len(poses), self.count, self._model
        wish = (goal - eye) / self.dt_s
        spin = (rotation(poses).mT @ speeds[..., 3:, None])[..., 0]  # MuJoCo has it in the body's own frame
        moving = torch.cat([speeds[..., :3], spin], 2).flatten(1)
        first = torch.cat([torch.zeros(batch, 1), poses.flatten(1), eye, moving, wish], 1).double().numpy()
        control = np.repeat(wish[:, None, :2].double().numpy(), self.steps, 1)
        states = np.empty((batch, self.steps, first.shape[1]))
        with self._lock:
            self._pool.rollout(model, self._data, np.ascontiguousarray(first), control, skip_checks=False,
                               nstep=self.steps, state=states)  # fmt: skip
        last = torch.from_numpy(states[:, -1]).float()
        after = last[:, 1 : 1 + 7 * count].view(batch, count, 7)
        after = torch.cat([after[..., :3], after[..., 3:] / after[..., 3:].norm(dim=2, keepdim=True)], 2)
        came = torch.cat([last[:, 1 + 7 * count : 3 + 7 * count], goal[:, 2:]], 1)
        begin = 1 + 7 * count + 3
        moving = last[:, begin : begin + 6 * count].view(batch, count, 6)
        spin = (rotation(after) @ moving[..., 3:, None])[..., 0]
        return after, torch.cat([moving[..., :3], spin], 2), came

    def boxes(self, poses: torch.Tensor) -> torch.Tensor:
        """Upright boxes [B, P, 6] around the parts of bodies at poses [B, K, 7], on which walkers can stand."""
        mine = self._own > 0
        number, part = self._own[mine].long() - 1, self._boxes[mine]
        half, off = (part[:, 3:] - part[:, :3]) / 2, (part[:, :3] + part[:, 3:]) / 2 - self.rest[number, :3]
        turn = rotation(poses)[:, number]
        middle = poses[:, number, :3] + (turn @ off[None, ..., None])[..., 0]
        wide = (turn.abs() @ half[None, ..., None])[..., 0]
        return torch.cat([middle - wide, middle + wide], 2)
