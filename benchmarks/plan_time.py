"""What a plan of the published protocol costs (300 candidates, 30 rounds, 5 moves of 5 actions), in a latent world and in a
predictor of LeWorldModel's size with random weights, in one run: processor seconds on one thread, which other work hardly changes.
And what iCEM's plans cost at which TwoRoom's starts are all solved (`make judge`): alone, and with a policy's plans as proposals.

    python benchmarks/plan_time.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from latent import preset
from torch import nn

from terrella.act.goal_network import GoalActor, GoalConfig, GoalNetwork
from terrella.act.planning import CostModel, Planner, SearchConfig, distance_to
from terrella.core import make_rng
from terrella.worlds.latent import LatentWorld
from terrella.worlds.latent_network import LatentNetwork

CANDIDATES, ROUNDS, MOVES, BLOCK, HISTORY = 300, 30, 5, 5, 3
WIDTH, LAYERS, HEADS, HEAD, MLP = 192, 6, 16, 64, 2048  # LeWorldModel's predictor, about 10M weights (Maes et al. 2026)


class Block(nn.Module):
    """A layer of a transformer whose heads together are wider than its tokens."""

    def __init__(self):
        super().__init__()
        self.first, self.second = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.into, self.out = nn.Linear(WIDTH, 3 * HEADS * HEAD), nn.Linear(HEADS * HEAD, WIDTH)
        self.mlp = nn.Sequential(nn.Linear(WIDTH, MLP), nn.GELU(), nn.Linear(MLP, WIDTH))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        parts = self.into(self.first(x)).unflatten(2, (3, HEADS, HEAD)).permute(2, 0, 3, 1, 4)
        seen = nn.functional.scaled_dot_product_attention(parts[0], parts[1], parts[2], is_causal=True)
        x = x + self.out(seen.transpose(1, 2).flatten(2))
        return x + self.mlp(self.second(x))


def made(pictures: bool, leap: int) -> LatentWorld:
    """The preset of benchmarks/latent.py, of pictures alone, with leaps or without."""
    world = preset(pictures)
    network = LatentNetwork(replace(world.network.config, leap=leap, vectors=(), sees_vectors=False))
    return LatentWorld(world.about, network, world.starts)


def spent(work: Callable[[], object], tries: int) -> float:
    """Processor seconds of a call, the least of a few."""
    best = float("inf")
    for _ in range(tries + 1):
        began = time.process_time()
        work()
        best = min(best, time.process_time() - began)
    return best


def decided(world: LatentWorld, samples: int, rounds: int, proposed: bool) -> Callable[[], object]:
    """A decision of iCEM that plans anew, as `judge.py` has it."""
    goal = {"rgb": torch.randint(0, 256, (64, 64, 3), dtype=torch.uint8)}
    seen = {"rgb": torch.randint(0, 256, (1, 64, 64, 3), dtype=torch.uint8)}
    config = SearchConfig("icem", samples=samples, iterations=rounds, horizon=MOVES, block=BLOCK, replan=MOVES)
    actor = GoalActor(GoalNetwork(GoalConfig.of(world.spec)), world.spec, varied=True) if proposed else None
    planner = Planner(world, distance_to(world, goal, "last"), config, proposal=actor)
    return lambda: planner.act(seen, planner.begin(1, make_rng(0)), make_rng(0))


@torch.inference_mode()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=5)
    tries = parser.parse_args().tries
    torch.set_num_threads(1)
    shown = torch.randint(0, 256, (1, CANDIDATES, 1, 64, 64, 3), dtype=torch.uint8)
    plans = torch.randn(1, CANDIDATES, MOVES, BLOCK * 2)
    large = nn.Sequential(*(Block() for _ in range(LAYERS))).eval()
    tokens = torch.randn(CANDIDATES, HISTORY, WIDTH)
    found = {}
    for name, leap in (("a latent world, in leaps of five", 5), ("the same step by step", 0)):
        model = CostModel(made(True, leap))
        found[name] = ROUNDS * spent(lambda model=model: model.get_cost({"pixels": shown, "goal": shown}, plans), tries)
    found["a predictor of LeWorldModel's size"] = ROUNDS * MOVES * spent(lambda: large(tokens), tries)
    weights = sum(weight.numel() for weight in large.parameters())
    print(
        f"| {CANDIDATES} x {ROUNDS}, {MOVES} moves of {BLOCK} | processor seconds a plan | of the first |\n| --- | --- | --- |"
    )
    for name, seconds in found.items():
        print(f"| {name} | {seconds:.2f} | {seconds / next(iter(found.values())):.1f} x |")
    print("\n| iCEM, 5 moves of 5 | processor milliseconds a plan |\n| --- | --- |")
    for samples, rounds, proposed in ((64, 5, False), (16, 2, False), (16, 2, True)):
        ms = 1000 * spent(decided(made(True, BLOCK), samples, rounds, proposed), tries)
        print(f"| {samples} x {rounds}{', with proposals of a policy' if proposed else ''} | {ms:.0f} |")
    print(f"\nThe large predictor has {weights / 1e6:.1f}M weights, and its encoder is not counted.")


if __name__ == "__main__":
    main()
