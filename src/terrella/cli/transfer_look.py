"""One seed of `terrella transfer --camera`: encoders that read the goal off a picture, and worlds whose policies are told it so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..core.world import World, make_rng
from ..learn.feeds import Drawn
from ..learn.objectives.adaptation import Adaptation, Encoder, Pictures
from ..learn.trainer import Run, Trainer
from ..sim.perceived import GOAL, Perceived
from ..sim.randomised import Randomised, read
from .say import say
from .transfer import PICTURE

LABELLED, UNLABELLED = (
    2048,
    512,
)  # pictures of the simulator, of which the goal is known; of the real one, of which it is not
STEPS = 1000
LABELLED_SEED, UNLABELLED_SEED = 3_000_003, 4_000_003
ENCODERS = ("nominal", "randomised", "adversarial", "oracle")


class Encoders:
    """The encoders of one seed: nominal has seen the simulator, randomised many looks of it, adversarial those and
    the real one without labels, oracle the real one with labels. looks: the file of what is randomised."""

    def __init__(self, sim: str, real: World, looks: str, folder: Path, seed: int):
        self.sim: World = library.load(sim, cameras=None, size=PICTURE, threads=1)
        self.real, self.looks, self.folder, self.seed = real, looks, folder, seed

    @cached_property
    def _looks(self) -> tuple[torch.Tensor, torch.Tensor]:
        return pictures(Randomised(self.sim, read(self.looks)), LABELLED, LABELLED_SEED + self.seed)

    def __getitem__(self, name: str) -> Encoder:
        """The encoder of this name, trained or as it was trained before."""
        if name == "randomised":
            shown = Pictures(*self._looks)
        elif name == "adversarial":
            shown = Pictures(*self._looks, pictures(self.real, UNLABELLED, UNLABELLED_SEED + self.seed)[0])
        else:
            world = self.real if name == "oracle" else self.sim
            shown = Pictures(*pictures(world, LABELLED, LABELLED_SEED + self.seed))
        torch.manual_seed(self.seed)
        encoder = Encoder(shown.numbers.shape[1])
        encoder.settle(shown.numbers)
        facts: Mapping[str, Any] = {"encoder": name}
        run = Run(self.folder / f"encoder {name}", facts, lambda *_: None, self.seed)
        Trainer(run, "encoder", Drawn(shown.batch), Adaptation(encoder), STEPS).train()
        say(f"seed {self.seed}: the {name} encoder is trained")
        return encoder.eval()

    def error(self, encoder: Encoder) -> float:
        """Mean distance between the goal that it reads off pictures of the real one and the true one, in the goal's units."""
        shown, goals = pictures(self.real, 256, UNLABELLED_SEED - 1)
        with torch.inference_mode():
            return float((encoder(shown) - goals).norm(dim=1).mean())


def pictures(world: World, count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """uint8 [count, H, W, 3] and goals [count, n] where episodes begin."""
    found, rng = [], make_rng(seed)
    for _ in range(0, count, 256):
        state = world.start(256, rng)
        found.append((world.render(state, ("rgb",))["rgb"], state[GOAL].float()))
    shown, goals = (torch.cat(part)[:count] for part in zip(*found))
    return shown, goals


def told_by(encoder: Encoder, world: World) -> Perceived:
    """`world`, whose policies are told the goal by the encoder."""

    @torch.inference_mode()
    def read_off(shown: torch.Tensor) -> torch.Tensor:
        return encoder(shown)

    return Perceived(world, read_off)


def arms_of(policies: Sequence[str], adapted: str) -> dict[str, tuple[str, str]]:
    """name -> (policy, encoder): each alone and both, and every encoder with the policy that is adapted to the dynamics."""
    best = next((name for name in (adapted, "oracle") if name in policies), "nominal")
    found = {"nominal": ("nominal", "nominal"), "visual": ("nominal", "randomised")}
    if "randomised" in policies:
        found["both"] = ("randomised", "randomised")
    more = {f"{best}, {name} encoder": (best, name) for name in ENCODERS}
    return found | {arm: pair for arm, pair in more.items() if pair not in found.values()}
