"""ObservedGoal: a goal of skills that is an observation, a picture or numbers, instead of words."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium.spaces import Box

from ...core.errors import PlanningError
from ...core.spec import Spec, kind_of
from ...core.world import Observation
from ..planning.costs import checked_goal, distance
from .library import SkillLibrary

NEARLY = 0.5  # of the largest share of ends within the distance: instructions from which on are as good
FAR = 0.5  # a distance from which on no larger one is advised: nearly everything is as near
FIT = 1.05  # a distance that is advised is so much larger than the nearest end's


@dataclass(frozen=True)
class ObservedGoal:
    """text: as it was written. value: channel -> [1, *shape], pictures as large as those of the library; NaN matches any number.
    within: the distance at which it is reached, in shares of a range or of full brightness, as of `distance`."""

    text: str
    value: Observation
    spec: Spec
    within: float

    @staticmethod
    def of(text: str, value: Observation, spec: Spec, within: float, library: SkillLibrary) -> ObservedGoal:
        """PlanningError for a channel that the library does not see, and a value that does not fit its channel."""
        if unseen := [name for name in value if name not in library.ends]:
            seen = ", ".join(library.ends)
            raise PlanningError(
                f"the skills do not see '{unseen[0]}'; they see {seen}. Give a goal of these, or in words."
            )
        goal = checked_goal(spec, value)
        if all(bool(one.float().isnan().all()) for one in goal.values()):
            raise PlanningError(f"{text} leaves every number open; give one or more.")
        goal = {name: _resized(name, one, library.ends[name]) for name, one in goal.items()}
        pictures = {
            name: Box(0, 255, tuple(one.shape[1:]), np.uint8) for name, one in goal.items() if kind_of(name) == "rgb"
        }
        return ObservedGoal(text, goal, replace(spec, channels={**spec.channels, **pictures}), within)

    def __str__(self) -> str:
        return self.text

    def distance(self, seen: Observation) -> torch.Tensor:
        """Of observations [N, ...]: [N]."""
        sized = {name: _resized(name, seen[name], one) for name, one in self.value.items()}
        return distance(self.spec, self.value, sized).cpu()

    def instructions(self, library: SkillLibrary) -> tuple[str, ...]:
        """Those that end within the distance nearly as often as the one that does most often. PlanningError if none does."""
        away, texts = self.distance(library.ends), list(dict.fromkeys(text for text in library.end_texts if text))
        rows = {text: torch.tensor([each == text for each in library.end_texts]) for text in texts}
        shares = {text: float((away[rows[text]] <= self.within).float().mean()) for text in texts}
        most = max(shares.values(), default=0.0)
        if not most:
            nearest = min(texts, key=lambda text: float(away[rows[text]].min()))
            least = float(away[rows[nearest]].min())
            wider = f", or --within {FIT * least:.2g}" if least < FAR else ""
            raise PlanningError(
                f"no skill ends within {self.within:g} of {self.text}: '{nearest}' comes nearest, {least:.3g} away; give another "
                f"goal{wider}."
            )
        return tuple(text for text in texts if shares[text] >= NEARLY * most)


def _resized(name: str, pictures: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Pictures [N, H, W, 3] in the size of others; anything else as it is."""
    if kind_of(name) != "rgb" or pictures.shape[1:3] == like.shape[1:3]:
        return pictures
    size = (like.shape[1], like.shape[2])
    return F.interpolate(pictures.permute(0, 3, 1, 2).float(), size, mode="area").permute(0, 2, 3, 1)
