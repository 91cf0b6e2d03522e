"""Goals that are places, for `terrella plan`: a pose, where a picture was taken, or views of a recording far from the start."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ..act.planning import STRIDE_S, Destination, PlayedEpisode, PlayResult, PlaySettings, SuccessCriterion, play
from ..act.planning.routes import NoRoute
from ..core.errors import ObservationError, PlanningError
from ..core.policy import Policy
from ..core.spec import Spec
from ..core.world import Observation, World, make_rng
from ..data import Dataset
from .goals import placed

WALK_S = 30.0  # of the world, of an episode, where the environment sets no limit
SAMPLES, MOVES = 32, 4  # of a walker's search, unless it is said
_WAYS_M = 3.0  # from the nearest known place, within which a place can be walked to


@dataclass(frozen=True)
class Walks:
    """Episodes in which somebody walks: each to a view of its own, at least `apart_m` from its start, or all to one place.

    views: poses [N, 7]; one for all episodes, or those of a recording, of which each episode has one.
    """

    views: torch.Tensor
    apart_m: float
    within_m: float

    def played(
        self,
        real: World,
        policy_for: Callable[[Destination], Policy],
        episodes: int,
        steps: int,
        seed: int,
        sees: Sequence[str],
        keep: Sequence[str],
        report: Callable[[float, float], None],
    ) -> PlayResult:
        """As planning.play plays them. An episode in which no way is known has failed; of a lone place that is raised."""
        found, skipped, filmed = list[PlayedEpisode](), 0, False
        for number in range(episodes):
            own = seed + 1009 * number
            goal = self._goal(real, number, own)
            judge = judge_of(goal)
            try:
                one = play(real, policy_for(goal), 1, PlaySettings(steps, judge, sees, keep, 0 if filmed else 1), own)
                found, skipped, filmed = found + one.episodes, skipped + one.skipped, True
            except NoRoute:
                if len(self.views) == 1:
                    raise
                seen = real.render(real.start(1, make_rng(own)), judge.channels)
                found.append(PlayedEpisode(success=False, nearest=float(judge.distance(real, seen)[0])))
            report(number + 1, episodes)
        return PlayResult(found, skipped)

    def _goal(self, real: World, number: int, seed: int) -> Destination:
        if len(self.views) == 1:
            return Destination(self.views[0], self.within_m)
        here = real.render(real.start(1, make_rng(seed)), ("pose",))["pose"][0, :2].cpu()
        far = ((self.views[:, :2] - here).norm(dim=1) >= self.apart_m).nonzero()[:, 0]
        if not len(far):
            raise PlanningError(
                f"no view of that recording is {self.apart_m:g} m from where episode {number + 1} begins."
            )
        return Destination(
            self.views[far[int(torch.randint(len(far), (1,), generator=make_rng(seed + 1)))]], self.within_m
        )


def judge_of(goal: Destination) -> SuccessCriterion:
    """Reached is near the place, and facing as the view does."""

    def apart(spec: Spec, wanted: Observation, seen: Observation) -> torch.Tensor:
        return goal.distance_m(seen["pose"])

    return SuccessCriterion({"pose": goal.pose[None]}, goal.near_m, distance_to_goal=apart)


def search_of(world: Spec) -> dict[str, int]:
    """The defaults of a walker's search: a few short plans."""
    return {"samples": SAMPLES, "iterations": 1, "horizon": MOVES, "block": max(1, round(STRIDE_S / world.dt_s))}


def views_of(goal: str, wanted: Mapping[str, torch.Tensor], world: World, real: Spec) -> torch.Tensor | None:
    """The poses [N, 7] that a goal asks to walk to; None where it asks for something else, or nobody walks there.

    Of a recording, the views that were taken near where the world has been. PlanningError or ObservationError for what cannot be.
    """
    walked = {"pose", "places"} <= set(world.spec.channels) and "pose" in real.channels
    if is_recording(goal):
        if not walked:
            raise PlanningError(
                f"{world.spec.name} knows no places to walk to, so the views of {goal} are no goals there."
            )
        return _near(_poses(goal), _places(world), goal)
    if not walked or set(wanted) not in ({"pose"}, {"rgb"}):
        return None
    told = placed({name: value[None] for name, value in wanted.items()}, world)
    if "pose" not in told or not bool(torch.isfinite(told["pose"][0, :2]).all()):
        return None
    pose, known = told["pose"].cpu(), _places(world)
    if set(wanted) == {"rgb"} and len(known) and float((known - pose[:, :2]).norm(dim=1).min()) > _WAYS_M:
        raise ObservationError(
            f"{world.spec.name} does not recognise where {goal} was taken; give pose=X,Y,_,_,_,_,_ instead."
        )
    return pose


def is_recording(goal: str) -> bool:
    return (Path(goal) / "meta" / "info.json").is_file()


def _poses(folder: str) -> torch.Tensor:
    dataset = Dataset(folder)
    if not dataset.has("pose"):
        raise PlanningError(f"{folder} holds no poses, so nobody knows where its views were taken.")
    read = partial(dataset.episode, names=("pose",))
    return torch.from_numpy(np.concatenate([read(number)["pose"] for number in range(len(dataset.episodes))]))


def _places(world: World) -> torch.Tensor:
    """Where a camera was that the world remembers [N, 2], metres."""
    held = world.render(world.start(1, make_rng(0)), ("places",))["places"][0].cpu()
    return held[held[:, 3] > 0, :2]


def _near(poses: torch.Tensor, places: torch.Tensor, goal: str) -> torch.Tensor:
    near = torch.cat([torch.cdist(part[:, :2], places).amin(1) < _WAYS_M / 2 for part in poses.float().split(4096)])
    if int(near.sum()) < 2:
        raise PlanningError(f"{goal} was recorded where the world has never been: no way to its views is known.")
    return poses[near].float()
