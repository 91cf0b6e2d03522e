"""Encoders for `transfer --camera`: they read the goal off a picture, and policies are shown that goal."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..core.world import World, make_rng
from ..learn.feeds import RandomBatches
from ..learn.objectives.adaptation import Adaptation, KeypointEncoder, LabelledPictures
from ..learn.trainer import Run, Trainer
from ..sim.perceived import GOAL, Perceived
from ..sim.randomised import Randomised, read
from .progress import Progress
from .transfer_experiment import PICTURE

LABELLED = 2048  # pictures with their goals
UNLABELLED = 512  # pictures of the real robot without goals
TESTED = 256  # real pictures by which the error of an encoder is measured
BATCH = 256  # pictures that are taken at once
STEPS = 1000
LABELLED_SEED, UNLABELLED_SEED = 3_000_003, 4_000_003
ENCODERS = ("nominal", "randomised", "adversarial", "oracle")


class Encoders:
    """The encoders of one seed, by what they are trained on: nominal (the simulator), randomised (many looks of it, from the file
    `looks`), adversarial (those, and real pictures without labels) and oracle (real pictures with labels)."""

    def __init__(self, sim: str, real: World, looks: str, folder: Path, seed: int, progress: Progress):
        self.sim: World = library.load(sim, cameras=None, size=PICTURE, threads=1)
        self.real, self.looks, self.folder, self.seed, self.progress = real, looks, folder, seed, progress

    @cached_property
    def _looks(self) -> tuple[torch.Tensor, torch.Tensor]:
        return pictures(Randomised(self.sim, read(self.looks)), LABELLED, LABELLED_SEED + self.seed)

    @cached_property
    def _test_pictures(self) -> tuple[torch.Tensor, torch.Tensor]:
        return pictures(self.real, TESTED, UNLABELLED_SEED - 1)

    def __getitem__(self, name: str) -> KeypointEncoder:
        """The encoder of this name, trained or loaded."""
        if name == "randomised":
            shown = LabelledPictures(*self._looks)
        elif name == "adversarial":
            shown = LabelledPictures(*self._looks, pictures(self.real, UNLABELLED, UNLABELLED_SEED + self.seed)[0])
        else:
            world = self.real if name == "oracle" else self.sim
            shown = LabelledPictures(*pictures(world, LABELLED, LABELLED_SEED + self.seed))
        torch.manual_seed(self.seed)
        encoder = KeypointEncoder(shown.numbers.shape[1])
        encoder.settle(shown.numbers)
        facts: Mapping[str, Any] = {"encoder": name}
        run = Run(self.folder / f"encoder {name}", facts, lambda *_: None, self.seed)
        Trainer(run, "encoder", RandomBatches(shown.batch), Adaptation(encoder), STEPS).train()
        self.progress(f"seed {self.seed}: the {name} encoder is trained")
        return encoder.eval()

    def error(self, encoder: KeypointEncoder) -> float:
        """Mean distance between the goal that it reads off real pictures and the true one, in the goal's units."""
        shown, goals = self._test_pictures
        with torch.inference_mode():
            return float((encoder(shown) - goals).norm(dim=1).mean())


def pictures(world: World, count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures uint8 [count, H, W, 3] and goals [count, n] at the start of episodes."""
    batches, rng = [], make_rng(seed)
    for _ in range(0, count, BATCH):
        state = world.start(BATCH, rng)
        batches.append((world.render(state, ("rgb",))["rgb"], state[GOAL].float()))
    shown, goals = (torch.cat(part)[:count] for part in zip(*batches))
    return shown, goals


def with_encoder(world: World, encoder: KeypointEncoder) -> Perceived:
    """The world, in which policies see the goal that the encoder reads off a picture."""

    @torch.inference_mode()
    def goal_of(shown: torch.Tensor) -> torch.Tensor:
        return encoder(shown)

    return Perceived(world, goal_of)


def camera_arms(policies: Sequence[str], adapted: str) -> dict[str, tuple[str, str]]:
    """name -> (policy, encoder): each kind of randomisation alone, both, and every encoder with the policy that is adapted to the
    real dynamics."""
    best = next((name for name in (adapted, "oracle") if name in policies), "nominal")
    arms = {"nominal": ("nominal", "nominal"), "visual": ("nominal", "randomised")}
    if "randomised" in policies:
        arms["both"] = ("randomised", "randomised")
    more = {f"{best}, {name} encoder": (best, name) for name in ENCODERS}
    return arms | {arm: pair for arm, pair in more.items() if pair not in arms.values()}
