"""The steps of a training run: resumed exactly, logged, saved, and drawn now and then."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ..core.errors import TrainingError
from .run_folder import load_run, save_run

Report = Callable[[float, float, str], None]


class Updates:
    """The run in the folder `out`, which goes on where it stopped; TrainingError where that run had another `recipe`.

    facts: what is known of it: recipe, step, seconds, and whatever else is `told` of it, saved with the rest.

    All of a step's randomness comes from (seed, step): an interrupted run sees what an unbroken one would.
    """

    def __init__(self, out: str | Path, recipe: dict, modules: dict[str, nn.Module], optimisers: dict, **told: Any):
        self.out, self.modules, self.optimisers = Path(out), modules, optimisers
        self.out.mkdir(parents=True, exist_ok=True)
        self.facts: dict[str, Any] = {"recipe": json.loads(json.dumps(recipe)), "step": 0, "seconds": 0.0, **told}
        found = load_run(self.out, {}, {})
        if found and found.get("recipe") != self.facts["recipe"]:
            raise TrainingError(f"{self.out} holds a run with other settings; repeat them, or give another --out.")
        if found:
            self.facts |= load_run(self.out, modules, optimisers) or found

    def run(
        self,
        steps: int,
        update: Callable[[int], dict[str, float]],
        draw: Callable[[], None],
        save_every_s: float,
        strip_every_s: float,
        report: Report,
        hours: float = float("inf"),
    ) -> None:
        """`update(step)` until `steps` are done, or `hours` are over, those of earlier runs counted in; `draw()` now and
        then, which leaves what there is to look at."""
        facts, recent, whole = self.facts, [], True
        began = saved = drawn = time.monotonic()
        before = facts["seconds"]
        try:
            while facts["step"] < steps and facts["seconds"] < 3600 * hours:
                whole = False  # a step that Ctrl-C cuts is not saved: the last save goes on exactly
                recent.append(update(facts["step"]))
                facts["step"] += 1
                whole = True
                now = time.monotonic()
                facts["seconds"] = before + now - began
                if now - saved > save_every_s:
                    self.save()
                    saved = now
                over = facts["step"] >= steps or facts["seconds"] >= 3600 * hours
                if len(recent) == 20 or over:
                    self._log(recent, max(facts["step"] / steps, facts["seconds"] / (3600 * hours)), report)
                    recent = []
                if now - drawn > strip_every_s:
                    draw()
                    drawn = time.monotonic()
        except KeyboardInterrupt:
            if whole:
                self.save()
            raise
        self.save()

    def save(self) -> None:
        save_run(self.out, self.modules, self.optimisers, self.facts)

    @property
    def outcome(self) -> dict[str, Any]:
        """The facts without the recipe."""
        return {name: fact for name, fact in self.facts.items() if name != "recipe"}

    def _log(self, recent: list[dict[str, float]], share: float, report: Report) -> None:
        mean = {name: float(np.mean([one[name] for one in recent if name in one])) for name in recent[-1]}
        with open(self.out / "log.jsonl", "a") as file:
            file.write(json.dumps({"step": self.facts["step"], "seconds": round(self.facts["seconds"]), **mean}) + "\n")
        report(share, 1.0, " ".join(f"{name} {value:.4f}" for name, value in mean.items()))


def descend(optimiser: torch.optim.Optimizer, loss: torch.Tensor, step: int, *modules: nn.Module) -> None:
    """One step down the gradient, the norm of each module's cut at 1; TrainingError where it is not a number."""
    optimiser.zero_grad()
    loss.backward()
    for module in modules:
        if not torch.isfinite(nn.utils.clip_grad_norm_(module.parameters(), 1.0)):
            raise TrainingError(
                f"a gradient is not a number at step {step}; the last save is good: lower --learning-rate."
            )
    optimiser.step()


def device_named(name: str) -> torch.device:
    """cpu, cuda, or auto: a GPU where there is one. TrainingError where one is asked for and there is none."""
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise TrainingError("there is no GPU that PyTorch can use here: leave --device out, or say cpu.")
    return torch.device(name if name != "auto" else "cuda" if torch.cuda.is_available() else "cpu")
