"""The tasks of `mujoco:table`: what an episode asks for, where things are when it begins, and when it has succeeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..core import chance
from ..core.instruction import embed, text_to_bytes
from ..core.spec import EVENT, INSTRUCTION, TEXT
from .mujoco_tasks import Evaluation, RobotLayout, Spaces, Tensors, numbers
from .table_hand import SPEED
from .table_scene import BLOCK_M, COLOURS, CUP_M, DRAWER_M, HANDLE, PLACED, WALL_M
from .table_teacher import ABOVE_M, TableState, advice, drawer_of
from .table_words import ALONE, TASKS, text_of

BLOCKS = ((-0.14, -0.09), (0.05, 0.07))  # corners of the area where blocks begin, m
CUPS, SHIFT_M = ((-0.1, -0.255), (0.05, -0.225)), 0.02  # corners of the cup's area; by how much the cabinet is shifted
APART_M, LANE_M, AHEAD_M = (
    0.09,
    0.06,
    0.12,
)  # between blocks; half the width and the length of what is free beside a pushed one
NEAR_M = 0.025  # how near the tip must be to its place above a block that it reaches
PUSHED_M, LIFTED_M, OPEN_M, SHUT_M = 0.05, 0.07, 0.08, 0.012
LET_GO_M = 2 * BLOCK_M + 0.006  # a gap between the fingers at which they hold no block
_JOBS, _PLACES, _LEFT_OPEN, _WORDS = 21, 22, 23, 24  # streams of random numbers
_DRAWN = 160  # arrangements from which the first that leaves room is taken


@dataclass(frozen=True)
class TableTask:
    """Reward 1 and the end when the state fulfils the instruction. Left and right are those of the front camera's picture.

    `expert` is the scripted teacher's action in each state, and `truth` where things are (red, green, blue, cup: x, y, z; the
    drawer's opening; its handle): policies do not see these unless they are named."""

    rewards = True
    tasks: tuple[str, ...] = ALONE  # an episode draws one of these
    free: bool = False  # no instruction, and no end but that of time: for those who give their own
    unseen: bool = False  # whether instructions have wordings that are held out from training
    closed_m: float = 0.0  # gap between the fingers where both slides are at 0

    def channels(self, layout: RobotLayout) -> Spaces:
        joints = len(layout.hinges[0]) - 2
        return {
            "hand": (numbers(4), "m"), "joints": (numbers(joints), ""), "joint_speeds": (numbers(joints), ""),
            "success": (EVENT, ""), "text": (TEXT, ""), "instruction": (INSTRUCTION, ""), "expert": (numbers(4), ""),
            "truth": (numbers(3 * len(COLOURS) + 7), "m"),
        }  # fmt: skip

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        drawn = chance.uniform(seeds, (4,), _JOBS).double()
        known = torch.tensor([TASKS.index(name) for name in self.tasks])
        count = len(COLOURS)
        block, side = (drawn[:, 1] * count).long(), (drawn[:, 3] * 2).long()
        other = (block + 1 + (drawn[:, 2] * (count - 1)).long()) % count
        job = torch.stack([known[(drawn[:, 0] * len(known)).long()], block, other, side], 1)
        opened = job[:, 0] == TASKS.index("close")
        kept = self._placed(seeds, job, opened | (job[:, 0] == TASKS.index("store")), qpos)
        wording = (3 * chance.uniform(seeds, (), _WORDS)).long()
        return {**kept, "job": job, "wording": wording}

    def _placed(self, seeds: Tensor, job: Tensor, opened: Tensor, qpos: Tensor) -> dict[str, Tensor]:
        """Draws where things are into `qpos`, with room for the jobs [B, 4]. Returns what the state keeps of that."""
        count, blocks = len(COLOURS), self._arranged(seeds, job)
        rest = chance.uniform(seeds, (4,), _LEFT_OPEN).double()
        cup = _within(rest[:, :2], CUPS)
        upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(seeds), count, 4)
        placed = torch.cat([blocks, torch.full((len(seeds), count, 1), BLOCK_M), upright], 2).flatten(1)
        placed = torch.cat([placed, cup, torch.full((len(seeds), 1), WALL_M / 2), upright[:, 0]], 1)
        shut = 0.15 * DRAWER_M * rest[:, 3]
        opening = torch.where(opened, DRAWER_M * (0.7 + 0.3 * rest[:, 3]), shut)
        shift = SHIFT_M * (2 * rest[:, 2] - 1)
        qpos[:, -PLACED:] = torch.cat([placed, shift[:, None], opening[:, None]], 1)
        return {"began": blocks, "success": torch.zeros(len(seeds), dtype=torch.bool)}

    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation:
        success = self.succeeded(self.scene(layout, after)) & (not self.free)
        return (
            success.float(),
            success,
            {name: after[name] for name in ("job", "wording", "began")} | {"success": success},
        )

    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor:
        if name == "success":
            return state["success"]
        if name in ("text", "instruction"):
            read = text_to_bytes if name == "text" else embed
            return torch.from_numpy(np.stack([read(text) for text in self.texts(state)]))
        if name in ("joints", "joint_speeds"):
            part, own = (layout.qpos, layout.hinges[0]) if name == "joints" else (layout.qvel, layout.hinges[1])
            return state["physics"][:, part][:, own[:-2]].float()
        scene = self.scene(layout, state)
        if name == "hand":
            return torch.cat([scene.hand, scene.gap[:, None]], 1).float()
        if name == "expert":
            return advice(scene, SPEED, layout.step_s).float()
        return torch.cat([scene.blocks.flatten(1), scene.cup, scene.opening[:, None], scene.handle], 1).float()

    def texts(self, state: Tensors) -> list[str]:
        """What each state asks for now."""
        rows = zip(state["job"].tolist(), state["wording"].tolist())
        return ["" if self.free else text_of(tuple(job), wording, self.unseen) for job, wording in rows]

    def scene(self, layout: RobotLayout, state: Tensors) -> TableState:
        """Where everything is."""
        qpos = state["physics"][:, layout.qpos]
        placed, fingers = qpos[:, -PLACED:], qpos[:, layout.hinges[0][-4:-2]]
        poses = placed[:, :-2].unflatten(1, (len(COLOURS) + 1, 7))
        shift, opening = placed[:, -2], placed[:, -1]
        handle = torch.stack([HANDLE[0] - opening, HANDLE[1] + shift, torch.full_like(shift, HANDLE[2])], 1)
        return TableState(
            state["job"], state["sensors"][:, layout.sensors["hand"]], fingers.abs().sum(1) + self.closed_m, poses[:, :-1, :3],
            state["began"], poses[:, -1, :3], opening, handle,
        )  # fmt: skip

    # -- success ------------------------------------------------------------------------------------------------------

    def succeeded(self, scene: TableState) -> Tensor:
        """bool [B]: whether the job that is due is done."""
        done = torch.stack(
            [self._reached(scene), self._pushed(scene), scene.target[:, 2] > LIFTED_M, self._in_cup(scene),
             scene.opening > OPEN_M, scene.opening < SHUT_M, self._stacked(scene), self._stored(scene)], 1,
        )  # fmt: skip
        return done.gather(1, scene.job[:, :1])[:, 0]

    def _reached(self, scene: TableState) -> Tensor:
        above = scene.target + torch.tensor([0, 0, ABOVE_M], dtype=torch.float64)
        return (scene.hand - above).norm(dim=1) < NEAR_M

    def _pushed(self, scene: TableState) -> Tensor:
        """Moved to its side, on the table, and not much to the front or the back."""
        x, y = (scene.target[:, :2] - scene.target_began).unbind(1)
        return (y * scene.way > PUSHED_M) & (x.abs() < 0.04) & (scene.target[:, 2] < 1.5 * BLOCK_M)

    def _in_cup(self, scene: TableState) -> Tensor:
        inside = (scene.target[:, :2] - scene.cup[:, :2]).abs().amax(1) < CUP_M
        return inside & (scene.target[:, 2] < 0.04) & (scene.gap > LET_GO_M)

    def _stored(self, scene: TableState) -> Tensor:
        """In the drawer, on its bottom."""
        apart = (scene.target - drawer_of(scene)).abs()
        return (apart[:, 0] < DRAWER_M / 2) & (apart[:, 1] < 0.045) & (apart[:, 2] < 0.012) & (scene.gap > LET_GO_M)

    def _stacked(self, scene: TableState) -> Tensor:
        apart = scene.target - scene.under
        on_top = (apart[:, :2].norm(dim=1) < BLOCK_M) & ((apart[:, 2] - 2 * BLOCK_M).abs() < 0.006)
        return on_top & (scene.gap > LET_GO_M)

    # -- arrangements -------------------------------------------------------------------------------------------------

    def _arranged(self, seeds: Tensor, job: Tensor) -> Tensor:
        """Places of the blocks [B, blocks, 2] with room for fingers, and for a block that is pushed."""
        count = len(COLOURS)
        places = _within(chance.uniform(seeds, (_DRAWN, count, 2), _PLACES).double(), BLOCKS)
        apart = places[:, :, :, None] - places[:, :, None]  # [B, drawn, block, other, 2]
        near = (apart.norm(dim=-1) < APART_M) & ~torch.eye(count, dtype=torch.bool)
        free = ~near.flatten(2).any(2)
        target = job[:, 1].view(-1, 1, 1, 1, 1).expand(-1, _DRAWN, 1, count, 2)
        beside = -apart.gather(2, target)[:, :, 0]  # from the pushed block to the others
        way = torch.where(job[:, 3] == 0, -1.0, 1.0)[:, None, None]
        in_lane = (beside[..., 0].abs() < LANE_M) & (beside[..., 1] * way < AHEAD_M) & (beside[..., 1] * way > -AHEAD_M)
        in_lane &= beside.norm(dim=-1) > 0
        free &= ~in_lane.any(2) | (job[:, :1] != TASKS.index("push"))
        return places[torch.arange(len(seeds)), free.float().argmax(1)]


def _within(drawn: Tensor, corners: tuple[tuple[float, float], tuple[float, float]]) -> Tensor:
    """Points [..., 2] in a box from numbers of 0 to 1."""
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in corners)
    return low + (high - low) * drawn
