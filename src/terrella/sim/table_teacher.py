"""The scripted teacher of `mujoco:table`: an action for every state, without a memory, so that it recovers from slips."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .table_scene import BLOCK_M, FIN_M, HANDLE

GAIN = 4.0  # 1/s, of the distance to where the hand should be
HOVER_M, GRASP_M, LOW_M = (
    0.115,
    0.018,
    0.016,
)  # heights of the tip: over everything, at a block on the table, when it pushes
FUNNEL = 3.0  # height above the goal by the distance to it, while the hand comes down
CLOSED_M = 0.003  # by which fingers around something are farther apart than it is wide, when they hold it
BEHIND_M = 0.05  # of a block that is pushed, of its middle
CARRY_M = 0.085  # height of the tip over the cup
IN_DRAWER_M, BOTTOM_M, OVER_M = (
    0.085,
    0.03,
    0.06,
)  # where a block lies in the drawer: behind the handle, and its middle's height; by how much higher it is let go
ABOVE_M = 0.045  # of the tip, of the middle of a block that it reaches
OPEN, CLOSE = 1.0, -1.0


@dataclass(frozen=True)
class TableState:
    """Where everything is in B states, float64, m."""

    job: Tensor  # int64 [B, 4]: numbers of the task, the block, the other block and the side
    hand: Tensor  # [B, 3], of the tip
    gap: Tensor  # [B], between the fingers
    blocks: Tensor  # [B, blocks, 3]
    began: Tensor  # [B, blocks, 2], where they were when the episode began
    cup: Tensor  # [B, 3]
    opening: Tensor  # [B], of the drawer
    handle: Tensor  # [B, 3], where it is grasped

    @property
    def target(self) -> Tensor:
        """[B, 3], the block that the task is about."""
        return _of(self.blocks, self.job[:, 1])

    @property
    def target_began(self) -> Tensor:
        return _of(self.began, self.job[:, 1])

    @property
    def under(self) -> Tensor:
        """[B, 3], the block on which the other is stacked."""
        return _of(self.blocks, self.job[:, 2])

    @property
    def way(self) -> Tensor:
        """[B]: 1 for pushes to the right, along y; -1 to the left."""
        return torch.where(self.job[:, 3] == 0, -1.0, 1.0).double()


def advice(scene: TableState, speed: float, step_s: float) -> Tensor:
    """The action [B, 4] for each state: velocities of up to `speed` m/s, and the gripper. step_s: seconds of a step."""
    plans = (_reach, _push, _pick, _place, _open, _close, _stack, _store)
    every = torch.stack([plan(scene) for plan in plans], 1)  # [B, tasks, 4]: where the tip should go, and the gripper
    plan = _of(every, scene.job[:, 0])
    velocity = GAIN * (plan[:, :3] - scene.hand)
    fastest = velocity.abs().amax(1, keepdim=True).clamp_min(1e-9)
    velocity = velocity * (speed / fastest).clamp_max(1)
    return torch.cat([velocity, plan[:, 3:]], 1)


def _of(rows: Tensor, at: Tensor) -> Tensor:
    return rows[torch.arange(len(rows)), at]


def _over(scene: TableState, goal: Tensor, grip: float | Tensor, funnel: float = FUNNEL) -> Tensor:
    """The plan [B, 4] to get to `goal` [B, 3] from above: the farther, the higher; sideways only when it is high enough."""
    away = (goal[:, :2] - scene.hand[:, :2]).norm(dim=1)
    height = (goal[:, 2] + funnel * (away - 0.006).clamp_min(0)).minimum(goal[:, 2].clamp_min(HOVER_M))
    share = (1 - (height - scene.hand[:, 2] - 0.01) / 0.03).clamp(0, 1)[:, None]
    level = scene.hand[:, :2] + share * (goal[:, :2] - scene.hand[:, :2])
    grip = torch.as_tensor(grip, dtype=torch.float64).expand(len(goal))
    return torch.cat([level, height[:, None], grip[:, None]], 1)


def _raised(point: Tensor, by: float) -> Tensor:
    return point + point.new_tensor([0, 0, by])


def _reach(scene: TableState) -> Tensor:
    return _over(scene, _raised(scene.target, ABOVE_M), OPEN)


def _push(scene: TableState) -> Tensor:
    way = scene.way
    behind = scene.target.clone()
    behind[:, 1] -= way * BEHIND_M
    behind[:, 2] = LOW_M
    x, y = (scene.hand - scene.target)[:, :2].unbind(1)
    ready = (x.abs() < 0.012) & (y * way < -0.02) & (y * way > -0.065) & (scene.hand[:, 2] < 0.03)
    along = scene.target.clone()
    along[:, 1] += 0.02 * way
    along[:, 2] = LOW_M
    pushed = torch.cat([along, torch.full_like(along[:, :1], CLOSE)], 1)
    return torch.where(ready[:, None], pushed, _over(scene, behind, CLOSE))


def _around(scene: TableState) -> Tensor:
    """bool [B]: whether the block is between the fingers."""
    offset = (scene.hand - scene.target).abs()
    return (offset[:, :2].amax(1) < 0.012) & (offset[:, 2] < 0.012)


def _held(scene: TableState) -> Tensor:
    return _around(scene) & (scene.gap < 2 * BLOCK_M + CLOSED_M)


def _grasped(scene: TableState) -> Tensor:
    """The plan to grasp the block."""
    goal = scene.target.clone()
    goal[:, 2] = (goal[:, 2] - 0.002).clamp_min(GRASP_M)
    closing = torch.cat([scene.hand, torch.full_like(goal[:, :1], CLOSE)], 1)
    return torch.where(_around(scene)[:, None], closing, _over(scene, goal, OPEN))


def _pick(scene: TableState) -> Tensor:
    up = torch.cat([_raised(scene.hand, 0.1), torch.full_like(scene.hand[:, :1], CLOSE)], 1)
    return torch.where(_held(scene)[:, None], up, _grasped(scene))


def _set_down(scene: TableState, goal: Tensor, close: float) -> Tensor:
    """The plan to let go of the block with its middle at `goal` [B, 3], within `close` m of it sideways."""
    offset = scene.target - scene.hand
    carried = _over(scene, goal - offset, CLOSE)
    above = ((scene.target - goal)[:, :2].norm(dim=1) < close) & ((scene.target - goal)[:, 2].abs() < 0.008)
    let_go = torch.cat([scene.hand, torch.full_like(goal[:, :1], OPEN)], 1)
    plan = torch.where(_held(scene)[:, None], carried, _grasped(scene))
    return torch.where(above[:, None], let_go, plan)


def _place(scene: TableState) -> Tensor:
    return _set_down(scene, _raised(scene.cup, CARRY_M), 0.02)


def _stack(scene: TableState) -> Tensor:
    return _set_down(scene, _raised(scene.under, 2 * BLOCK_M + 0.003), 0.007)


def drawer_of(scene: TableState) -> Tensor:
    """[B, 3], where the middle of a block is that lies in the drawer, behind its front."""
    return scene.handle + scene.handle.new_tensor([IN_DRAWER_M, 0, BOTTOM_M - HANDLE[2]])


def _store(scene: TableState) -> Tensor:
    return _set_down(scene, _raised(drawer_of(scene), OVER_M), 0.015)


def _open(scene: TableState) -> Tensor:
    offset = (scene.hand - scene.handle).abs()
    around = (offset[:, 0] < 0.015) & (offset[:, 1] < 0.009) & (offset[:, 2] < 0.012)
    held = scene.gap < 2 * FIN_M + CLOSED_M
    pull = scene.hand + scene.hand.new_tensor([-0.06, 0, 0])
    plan = torch.cat([torch.where(held[:, None], pull, scene.hand), torch.full_like(offset[:, :1], CLOSE)], 1)
    return torch.where(around[:, None], plan, _over(scene, scene.handle, OPEN))


def _close(scene: TableState) -> Tensor:
    before = scene.handle.clone()
    before[:, 0] -= 0.04
    x, y = (scene.hand - scene.handle)[:, :2].unbind(1)
    ready = (y.abs() < 0.012) & (x < 0) & (x > -0.06) & (scene.hand[:, 2] < HOVER_M / 2)
    push = scene.handle.clone()
    push[:, 0] += 0.05
    pushed = torch.cat([push, torch.full_like(x, CLOSE)[:, None]], 1)
    return torch.where(ready[:, None], pushed, _over(scene, before, CLOSE))
