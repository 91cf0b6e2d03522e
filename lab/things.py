"""What the things of a learned world do, beside what they did in a recording that it never saw: who falls, who goes how far.

    python lab/things.py runs/monsters/things recordings/fights-test

Stories begin with ten recorded frames; then the world's cast goes on by itself along the recorded poses and actions, and a
second time as if ATTACK had never been pressed. Nothing is drawn: this is about what happens, `terrella score` about looks.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import torch
import tyro

import terrella
from terrella.core import chance
from terrella.data import ClipCache
from terrella.learn.recording import Recording, controls_of
from terrella.space.billboards import cut_out
from terrella.space.camera import project
from terrella.worlds.learned import LearnedWorld
from terrella.worlds.objects import LOOK, NONE, NUMBER, PLACE, WIDE_M

CONTEXT = 10
TALL_M, LOW_M = 1.2, 0.75  # who was taller than the one and is lower than the other has fallen


def main(
    world: Annotated[str, tyro.conf.Positional],
    data: Annotated[str, tyro.conf.Positional],
    steps: int = 70,
    every: int = 40,
    dreams: int = 16,
) -> None:
    """Measure what things do.

    Args:
        world: A world whose things are cards.
        data: A recording of the same game that its training did not see.
        steps: Of a story.
        every: Rows of the recording from one story's beginning to the next.
        dreams: Of each story.
    """
    learned = terrella.load(world)
    if "objects" not in learned.spec.channels or "ATTACK" not in learned.spec.action_names:
        raise SystemExit(f"{world} is no world with billboards and a button ATTACK.")
    cache = ClipCache.open(data, learned.config.size)
    recording = Recording(cache, np.zeros(cache.length, np.int64), np.ones(cache.length, bool), controls_of(cache))
    rows = np.array([row for a, b in cache.episodes for row in range(a + CONTEXT, b - steps, every)])
    state = None
    for back in range(CONTEXT - 1, -1, -1):
        seen = recording.evidence(learned.config, rows - back)
        state = learned.observe(seen, state, terrella.make_rng(0))
    cards = state["billboards"]
    tall = learned.objects.boxes[cards[..., LOOK].long().clamp_min(0), 3]
    standing = (cards[..., NUMBER] > 0) & (cards[..., LOOK] != NONE) & (tall >= TALL_M)
    fell, known, truth = happened(cards[..., NUMBER], recording, rows, steps, learned.config.camera)
    rng, chance, places = terrella.make_rng(0), {}, torch.zeros(0)
    for pressed in (False, True):
        found = [dreamt(learned, cards, recording, rows, steps, pressed, rng) for _ in range(dreams)]
        chance[pressed] = torch.stack([fallen.float() for fallen, _ in found]).mean(0)[standing]
        places = torch.stack([place for _, place in found])
    fell = fell[standing]
    print(f"{int(standing.sum())} standing things in {len(rows)} stories of {steps} steps, {dreams} dreams of each")
    shot = shot_at(learned, known, truth, recording, rows)[standing]
    groups = {
        "all": fell | True,
        "those who fell": fell,
        "the others": ~fell,
        "those shot at": shot,
        "those not": ~shot,
    }
    for who, some in groups.items():
        if not some.any():
            continue
        share = [float(part[some].float().mean()) for part in (fell, chance[True], chance[False])]
        print(
            f"falls of {who} ({int(some.sum())}): game {share[0]:.1%}, dreams {share[1]:.1%}, without ATTACK {share[2]:.1%}"
        )
    yes, no = chance[True][fell, None], chance[True][~fell]
    print(f"who falls: AUC {float((yes > no).float().mean() + 0.5 * (yes == no).float().mean()):.2f}")
    for step in (8, 32, 64):
        if step > steps:
            break
        there = known[step - 1] & standing
        true, begun, dream = truth[step - 1][there], cards[..., PLACE][there], places[:, step - 1][:, there]
        ways = [
            float((a - b).norm(dim=-1).mean())
            for a, b in ((true, begun), (dream, begun), (dream, true), (dream.mean(0), true))
        ]
        print(
            f"after {step} steps ({int(there.sum())} in sight): {ways[0]:.3f} m from where they were, in dreams {ways[1]:.3f} m; a "
            f"dream is off by {ways[2]:.3f} m, the mean of dreams by {ways[3]:.3f} m"
        )


def happened(numbers: torch.Tensor, recording: Recording, rows: np.ndarray, steps: int, camera):
    """Of the things `numbers` [B, K] at `rows`, in the recording: who falls [B, K]; who is in sight after each step
    [steps, B, K], and where [steps, B, K, 3]."""
    fell, known, places = torch.zeros(numbers.shape, dtype=torch.bool), [], []
    for step in range(1, steps + 1):
        at = rows + step
        told = torch.from_numpy(np.array(recording.cache.arrays["observation.objects"][at], np.float32))
        frames = recording.rgb(at), recording.instances(at), recording.depth(at)
        cut = cut_out(*frames, told[..., 1:], recording.pose(at), camera)
        low = torch.zeros(told.shape[:2], dtype=torch.bool)
        low[cut.view, cut.row] = cut.whole & (cut.box[:, 3] < LOW_M)
        same = (told[:, None, :, 0] == numbers[:, :, None]) & (numbers > 0)[:, :, None]
        fell |= (same & low[:, None]).any(-1)
        known.append(same.any(-1))
        places.append(torch.einsum("bkj,bjc->bkc", same.float(), told[..., 1:]))
    return fell, torch.stack(known), torch.stack(places)


def shot_at(
    world: LearnedWorld, known: torch.Tensor, truth: torch.Tensor, recording: Recording, rows: np.ndarray
) -> torch.Tensor:
    """Who was looked at with ATTACK pressed [B, K], less than worlds/objects.WIDE_M beside its middle, of those in sight (`known`
    [steps, B, K], at `truth` [steps, B, K, 3] after each step)."""
    shot, button = torch.zeros_like(known[0]), world.spec.action_names.index("ATTACK")
    focal, _, centre, _ = world.config.camera
    for step, (seen, places) in enumerate(zip(known, truth)):
        where, ahead = project(places, recording.pose(rows + step + 1), world.config.camera)
        aside = (where[..., 0] - centre).abs() * ahead / focal
        shot |= seen & (ahead > 0.2) & (aside < WIDE_M) & (recording.action(rows + step)[:, button] > 0)[:, None]
    return shot


def dreamt(
    world: LearnedWorld, cards: torch.Tensor, recording: Recording, rows: np.ndarray, steps: int, attack: bool, rng
):
    """The same of the cards [B, K, COLUMNS] in a dream: who falls, and where all are after each step."""
    objects, history = world.objects, world.config.history
    fell, places = torch.zeros(cards.shape[:2], dtype=torch.bool), []
    button = world.spec.action_names.index("ATTACK")
    for step in range(1, steps + 1):
        led = rows[:, None] + step - history + np.arange(history)
        acts = recording.action(led.ravel()).view(*led.shape, -1).clone()
        acts[..., button] *= attack
        pose = recording.pose(rows + step)
        where, ahead = project(cards[..., PLACE], pose, world.config.camera)
        seeds = chance.seeds(len(cards), rng)
        cards = objects.act(cards, (ahead > 0.2) & ((where[..., 0] - 0.5).abs() < 0.5), pose, acts, seeds)
        look = cards[..., LOOK].long()
        fell |= (cards[..., NUMBER] > 0) & (look != NONE) & (objects.boxes[look.clamp_min(0), 3] < LOW_M)
        places.append(cards[..., PLACE])
    return fell, torch.stack(places)


if __name__ == "__main__":
    tyro.cli(main)
