"""CarRacing as a world: records 20,000 frames of a driver who keeps to the road that it sees, with lapses.

    python lab/car_racing.py record OUT       # OUT/rec (training) and OUT/test (other tracks), 64x64, exact pictures
    terrella train video OUT/rec --out OUT/run --name car-racing --size 64 64
    terrella score OUT/run --data OUT/test --fresh --out OUT/scores

The driver sees the picture alone: it steers towards the road some way ahead, and keeps a pace that changes every second or
two. One stretch in six it does something random (full lock, brake, full throttle), and then finds its way back if it can.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import torch

import terrella
from terrella.data import RecordOptions, record


class Drivers:
    """The Policy of a driver for each episode."""

    def begin(self, batch: int, rng: torch.Generator) -> list[Driver]:
        return [Driver() for _ in range(batch)]

    def act(
        self, observation: Mapping, memory: list[Driver], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[Driver]]:
        pairs = zip(memory, observation["rgb"], strict=True)
        return torch.cat([driver.act(picture, rng) for driver, picture in pairs]), memory


class Driver:
    """Plays one episode: see the top of this file."""

    def __init__(self):
        self.step, self.left, self.lapse = 0, 0, False
        self.throttle, self.eagerness, self.wild = 0.0, 1.0, torch.zeros(3)
        self.side, self.lost = 1.0, 0

    def act(self, picture: torch.Tensor, rng: torch.Generator) -> torch.Tensor:
        def chance() -> float:
            return float(torch.rand(1, generator=rng))

        if self.left <= 0:
            self.left = 20 + int(60 * chance())
            self.lapse = self.step > 60 and chance() < 1 / 6
            self.throttle, self.eagerness = 0.05 + 0.25 * chance(), 1.5 + 1.5 * chance()
            self.wild = torch.tensor([2 * chance() - 1, chance() * (chance() < 0.7), 0.8 * chance() * (chance() < 0.3)])
            self.left = min(self.left, 25) if self.lapse else self.left
        self.left, self.step = self.left - 1, self.step + 1
        if self.lapse:
            return self.wild[None]
        off = _road(picture)
        if off is None:  # off the road: turn round towards where it was
            self.lost += 1
            return torch.tensor([[self.side, 0.12, 0.0 if self.lost % 40 < 30 else 0.3]])
        self.lost, self.side = 0, 1.0 if off > 0 else -1.0
        steer = max(-1.0, min(1.0, self.eagerness * off))
        hard = abs(steer) > 0.6
        return torch.tensor([[steer, 0.0 if hard else self.throttle, 0.15 if hard and chance() < 0.3 else 0.0]])


def _road(picture: torch.Tensor) -> float | None:
    """How far right of the car the road's middle is, 10 to 25 pixels of 64 ahead of it, in half pictures; None without road.
    Road is grey (its colours differ by less than 20 of 255), grass is green."""
    height, width = picture.shape[:2]
    band = picture[int(0.38 * height) : int(0.62 * height)].float()
    grey = (band.amax(-1) - band.amin(-1) < 20) & (band.mean(-1) > 60)
    columns = grey.nonzero()[:, 1].float()
    return None if len(columns) < 12 else (float(columns.mean()) - (width - 1) / 2) / (width / 2)


def record_driving(out: Path, frames: int = 20_000, held_out: int = 5_000) -> None:
    world = terrella.load("gym:CarRacing-v3", size=(64, 64))
    for folder, seed, rows in (("test", 1, held_out), ("rec", 0, frames)):
        rng = terrella.make_rng(seed)
        done = record(
            world, Drivers(), out / folder, rows, rng, options=RecordOptions(max_episode_steps=900, pictures="png")
        )
        print(out / folder, done.rows, "rows", done.episodes, "episodes", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[1] != "record":
        sys.exit(__doc__)
    record_driving(Path(sys.argv[2]), *map(int, sys.argv[3:]))
