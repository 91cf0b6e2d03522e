"""Breakout and Pong as worlds: records 100,000 steps of a player who follows the ball, and trains, scores and shows them.

    python lab/atari.py record breakout OUT          # OUT/rec (training) and OUT/test (other seed), 64x64, exact pictures
    terrella train video OUT/rec --out OUT/run --name breakout --size 64 64
    terrella score OUT/run --data OUT/test --fresh --out OUT/scores

The player sees the picture alone. For 20 to 80 steps on end it follows the ball (with a random aim, and one action in ten
at random), or, one time in seven, holds random actions for 2 to 12 steps. Without a ball it serves at times.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

import terrella
from terrella.data import RecordOptions, record


@dataclass(frozen=True)
class Court:
    """Where a picture of 64x64 shows the ball and the paddle: rows and columns (first, after the last); axis 1: the
    paddle moves across, 0: up and down; back and forth: its actions towards smaller and greater numbers."""

    game: str
    ball: tuple[int, int, int, int]
    paddle: tuple[int, int, int, int]
    axis: int
    back: str
    forth: str


COURTS = {
    "breakout": Court("gym:ALE/Breakout-v5", (30, 56, 4, 59), (57, 59, 4, 59), 1, "LEFT", "RIGHT"),
    "pong": Court("gym:ALE/Pong-v5", (12, 58, 9, 55), (12, 58, 56, 58), 0, "RIGHT", "LEFT"),
}


@dataclass(frozen=True)
class BallPlayers:
    """The Policy of a player for each episode; names: those of the game's actions."""

    court: Court
    names: tuple[str, ...]

    def begin(self, batch: int, rng: torch.Generator) -> list[BallPlayer]:
        return [BallPlayer(self.court, self.names) for _ in range(batch)]

    def act(
        self, observation: Mapping, memory: list[BallPlayer], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[BallPlayer]]:
        pairs = zip(memory, observation["rgb"], strict=True)
        return torch.cat([player.act(picture, rng) for player, picture in pairs]), memory


class BallPlayer:
    """Plays one episode: see the top of this file."""

    def __init__(self, court: Court, names: tuple[str, ...]):
        self.court, self.names = court, names
        self.left, self.follows, self.aim = 0, True, 0.0
        self.held, self.hold = 0, 0

    def act(self, picture: torch.Tensor, rng: torch.Generator) -> torch.Tensor:
        if self.left <= 0:
            self.left = _whole(rng, 20, 80)
            self.follows = _unit(rng) < 0.85
            self.aim = 4 * _unit(rng) - 2
        self.left -= 1
        ball, paddle = (_place(picture, box, self.court.axis) for box in (self.court.ball, self.court.paddle))
        if ball is None and _unit(rng) < 0.2:
            return torch.tensor([self.names.index("FIRE")])
        if self.follows and ball is not None and paddle is not None and _unit(rng) < 0.9:
            off = ball + self.aim - paddle
            name = "NOOP" if abs(off) < 1.5 else self.court.forth if off > 0 else self.court.back
            return torch.tensor([self.names.index(name)])
        if self.hold <= 0:
            self.held, self.hold = _whole(rng, 0, len(self.names) - 1), _whole(rng, 2, 12)
        self.hold -= 1
        return torch.tensor([self.held])


def _place(picture: torch.Tensor, box: tuple[int, int, int, int], axis: int) -> float | None:
    """The middle, along `axis`, of what differs from the background (the usual colour) in a box of uint8 [H, W, 3]."""
    part = picture[box[0] : box[1], box[2] : box[3]].float()
    background = picture[12:58:4, 9:55:4].flatten(0, 1).float().median(0).values
    spots = ((part - background).abs().sum(-1) > 40).nonzero()
    return float(spots[:, axis].float().mean()) + box[2 * axis] if len(spots) else None


def _unit(rng: torch.Generator) -> float:
    return float(torch.rand(1, generator=rng))


def _whole(rng: torch.Generator, least: int, most: int) -> int:
    return int(torch.randint(least, most + 1, (1,), generator=rng))


def record_game(name: str, out: Path, frames: int = 100_000, held_out: int = 12_000) -> None:
    court = COURTS[name]
    for folder, seed, rows in (("test", 1, held_out), ("rec", 0, frames)):
        world = terrella.load(court.game, size=(64, 64), forkable=False)  # twice as fast
        player = BallPlayers(court, world.spec.action_names)
        rng = terrella.make_rng(seed)
        done = record(
            world, player, out / folder, rows, rng, options=RecordOptions(max_episode_steps=3000, pictures="png")
        )
        print(out / folder, done.rows, "rows", done.episodes, "episodes", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 4 or sys.argv[1] != "record" or sys.argv[2] not in COURTS:
        sys.exit(__doc__)
    record_game(sys.argv[2], Path(sys.argv[3]), *map(int, sys.argv[4:]))
