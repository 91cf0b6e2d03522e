"""Chains of tasks at the table: an episode asks for several things, one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..core import chance
from .mujoco_tasks import Evaluation, RobotLayout, Tensors
from .table_scene import COLOURS
from .table_tasks import TableTask
from .table_words import TASKS, text_of

THEN = ", then "  # between the instructions of a whole sentence
OPENED = 0.5  # share of the episodes that begin with an open drawer
_CHAINS, _WORDINGS = 25, 26  # streams of random numbers


@dataclass(frozen=True)
class TableChain(TableTask):
    """Tasks that can follow each other: reward 1 when each is done, in their order, and the end when all are.

    `text` is the instruction that is due, or of a chain that is `whole` the sentence of all of them throughout. `success` says that
    all are done."""

    length: int = 3  # tasks of an episode
    whole: bool = False

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        drawn = chance.uniform(seeds, (self.length, 4), _CHAINS).tolist()
        opened = chance.uniform(seeds, (), _CHAINS + 100) < OPENED
        jobs = torch.tensor([_chain(row, bool(one)) for row, one in zip(drawn, opened)])
        pushes = jobs[..., 0] == TASKS.index("push")
        roomy = jobs[torch.arange(len(jobs)), pushes.float().argmax(1)]  # the job that needs room beside its block
        kept = self._placed(seeds, roomy, opened, qpos)
        wordings = (3 * chance.uniform(seeds, (self.length,), _WORDINGS)).long()
        at = torch.zeros(len(seeds), dtype=torch.int64)
        return {
            **kept,
            "jobs": jobs,
            "wordings": wordings,
            "at": at,
            "job": jobs[:, 0].clone(),
            "wording": wordings[:, 0].clone(),
        }

    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation:
        scene = self.scene(layout, after)
        done = self.succeeded(scene)
        at = after["at"] + done
        every, over = torch.arange(len(at)), at == self.length
        due = at.clamp_max(self.length - 1)
        began = torch.where(done[:, None, None], scene.blocks[..., :2], after["began"])
        kept = {"job": after["jobs"][every, due], "wording": after["wordings"][every, due], "began": began, "at": at}
        return done.float(), over, {**kept, "jobs": after["jobs"], "wordings": after["wordings"], "success": over}

    def texts(self, state: Tensors) -> list[str]:
        return [THEN.join(steps) for steps in self.instructions(state)] if self.whole else super().texts(state)

    def instructions(self, state: Tensors) -> list[list[str]]:
        """The instructions of each state, in their order."""
        rows = zip(state["jobs"].tolist(), state["wordings"].tolist())
        return [[text_of(job, wording, self.unseen) for job, wording in zip(*row)] for row in rows]


def _chain(drawn: list[list[float]], opened: bool) -> list[tuple[int, int, int, int]]:
    """Jobs that can follow each other, from numbers of 0 to 1: [length, 4]. The cup and the drawer take one block each; what lies
    in them, in a stack, or was pushed aside twice is left alone; a block in the hand is put somewhere."""
    free, held, filled, jobs = list(range(len(COLOURS))), None, set[str](), []
    for number, (which, first, second, third) in enumerate(drawn):
        last = number == len(drawn) - 1
        put = [task for task in ("place", "store") if task not in filled and (task == "place" or opened)]
        if held is not None:
            options = [*put, *["stack"] * (len(free) > 1)]
        else:
            options = ["close", "close"] if opened else ["open", "open"]
            if free:
                options += ["reach", *put, *(["store"] if "store" in put else []), *["push"] * ("push" not in filled)]
                options += ["stack"] * (len(free) > 1) + ["pick"] * (last or len(free) > 1 or "place" in put)
        task = options[int(which * len(options))]
        block = held if held is not None else free[int(first * len(free))] if free else 0
        others = [one for one in free if one != block] or [(block + 1) % len(COLOURS)]
        other = others[int(second * len(others))]
        jobs.append((TASKS.index(task), block, other, int(third * 2)))
        held = block if task == "pick" else None
        opened = task == "open" or (opened and task != "close")
        filled |= {task} & {"place", "store", "push"}
        gone = {"place": (block,), "store": (block,), "stack": (block, other)}.get(task, ())
        free = [one for one in free if one not in gone]
    return jobs
