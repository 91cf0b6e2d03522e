"""Latent worlds: steps a second in batches, with gradients and without, beside one episode; and how far they see ahead.

python benchmarks/latent.py                                       # speed of both presets, of untrained networks
python benchmarks/latent.py RUN --data RECORDING [--steps 1 8 16 50]      # and of a trained world, its open-loop errors
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

import terrella
from terrella.core import make_rng, rollout
from terrella.learn.latent_validation import open_loop
from terrella.learn.recording import Recording
from terrella.worlds.controls import AXES, Controls
from terrella.worlds.latent import LatentWorld
from terrella.worlds.latent_network import LatentConfig, LatentNetwork
from terrella.worlds.learned import About


def preset(pictures: bool) -> LatentWorld:
    """As `train latent` makes it of pictures of 64 x 64, or of vectors; untrained, which costs the same."""
    controls, size, latent = (
        Controls(AXES, (-1.0,) * 2, (1.0,) * 2),
        (64, 64) if pictures else None,
        64 if pictures else 32,
    )
    config = LatentConfig(2, tuple(map(float, range(33))), (("observation", 6),), size, latent=latent)
    return LatentWorld(About("preset", controls, 0.1), LatentNetwork(config), torch.randn(16, latent))


def steps_per_second(world, batch: int, gradients: bool, steps: int = 16, tries: int = 3) -> float:
    """Of a rollout that asks for latent, reward and done, the best of three; with gradients, back to the actions too."""
    rng, best = make_rng(0), 0.0
    for _ in range(tries):
        state = world.start(batch, rng)
        actions = torch.stack([world.spec.sample_action(batch, rng) for _ in range(steps)])
        actions = actions.float().requires_grad_() if gradients else actions
        began = time.perf_counter()
        seen = rollout(world, state, actions, rng, ("latent", "reward", "done"), gradients=gradients).observations
        if gradients:
            torch.autograd.grad(seen["reward"].sum(), actions)
        best = max(best, batch * steps / (time.perf_counter() - began))
    return best


def seen_ahead(world, data: Path, steps: list[int]) -> None:
    shown = world.spec.channels.get("rgb")
    size = shown.shape[:2] if shown is not None else (64, 64)
    rolled = open_loop(world, Recording.open(data, size, lambda *_: None, needs=("action",)), steps)
    print(
        f"open loop, root mean square in standard deviations, {len(next(iter(rolled.latent.values())))} held-out clips"
    )
    for channel, arms in rolled.table().items():
        for arm, errors in arms.items():
            print(
                f"  {channel:14} {arm:17}", "  ".join(f"{step:>3} steps {value:.3f}" for step, value in errors.items())
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", nargs="?")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 8, 16, 50])
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    worlds = {"vectors": preset(False), "pictures": preset(True)}
    worlds |= {given.run: terrella.load(given.run)} if given.run else {}
    for name, world in worlds.items():
        one = steps_per_second(world, 1, False)
        many = steps_per_second(world, given.batch, False)
        line = f"{name}: {one:,.0f} steps/s with one episode, {many:,.0f} with {given.batch}"
        if world.spec.differentiable:
            line += f", {steps_per_second(world, given.batch, True):,.0f} with gradients"
        print(line, flush=True)
    if given.run and given.data:
        seen_ahead(worlds[given.run], given.data, given.steps)


if __name__ == "__main__":
    main()
