"""Goals that are places, for `plan`: a pose, where a picture was taken, or views of a recording far from the start."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ..act.planning import STRIDE_S, Destination, PlayedEpisode, PlayResult, PlaySettings, SuccessCriterion, play
from ..act.planning.episodes import PlayInterrupted
from ..act.planning.routes import NoRoute
from ..core.errors import ObservationError, PlanningError
from ..core.policy import Policy
from ..core.spec import Spec
from ..core.world import Observation, World, make_rng
from ..data import Dataset
from .goals import with_estimated_pose

WALK_S = 30.0  # world time of an episode at most, where the environment sets no limit
SAMPLES, MOVES = 32, 4  # defaults of the search
_REACHABLE_M = 3.0  # a place can be walked to if a known place is this near


@dataclass(frozen=True)
class PlaceGoals:
    """The goals of episodes that walk to a place."""

    views: torch.Tensor  # Poses [N, 7]: one for all episodes, or those of a recording, of which each episode draws one.
    apart_m: float  # A view that is drawn is at least this far from the start of its episode.
    within_m: float  # Distance at which a place is reached.

    def play(
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
        """As planning.play. An episode to which no way is known has failed; NoRoute where the goal is a single place."""
        played, skipped, filmed = list[PlayedEpisode](), 0, False
        for number in range(episodes):
            own = seed + 1009 * number
            try:
                goal = self._goal(real, number, own)
                criterion = criterion_of(goal)
                settings = PlaySettings(steps, criterion, sees, keep, 0 if filmed else 1)
                one = play(real, policy_for(goal), 1, settings, own)
                played, skipped, filmed = played + one.episodes, skipped + one.skipped, True
            except NoRoute:
                if len(self.views) == 1:
                    raise
                seen = real.render(real.start(1, make_rng(own)), criterion.channels)
                played.append(PlayedEpisode(success=False, nearest=float(criterion.distance(real, seen)[0])))
            except KeyboardInterrupt as stop:
                begun = stop.begun if isinstance(stop, PlayInterrupted) else ()
                raise PlayInterrupted(PlayResult(played, skipped), begun) from None
            report(number + 1, episodes)
        return PlayResult(played, skipped)

    def _goal(self, real: World, number: int, seed: int) -> Destination:
        if len(self.views) == 1:
            return Destination(self.views[0], self.within_m)
        here = real.render(real.start(1, make_rng(seed)), ("pose",))["pose"][0, :2].cpu()
        far = ((self.views[:, :2] - here).norm(dim=1) >= self.apart_m).nonzero()[:, 0]
        if not len(far):
            raise PlanningError(
                f"no view of that recording is {self.apart_m:g} m from where episode {number + 1} begins."
            )
        drawn = int(torch.randint(len(far), (1,), generator=make_rng(seed + 1)))
        return Destination(self.views[far[drawn]], self.within_m)


def criterion_of(goal: Destination) -> SuccessCriterion:
    """Success is to be near the place and to face as the view does."""

    def apart(spec: Spec, wanted: Observation, seen: Observation) -> torch.Tensor:
        return goal.distance_m(seen["pose"])

    return SuccessCriterion({"pose": goal.pose[None]}, goal.near_m, distance_to_goal=apart)


def walking_defaults(world: Spec) -> dict[str, int]:
    """Defaults of SearchConfig to walk to a place: a few short plans."""
    return {"samples": SAMPLES, "iterations": 1, "horizon": MOVES, "block": max(1, round(STRIDE_S / world.dt_s))}


def views_of(goal: str, values: Mapping[str, torch.Tensor], world: World, real: Spec) -> torch.Tensor | None:
    """The poses [N, 7] to which a goal asks to walk; None for another kind of goal, or a world without places.

    Of a recording: the views that were taken near places that the world knows. PlanningError or ObservationError where there is
    no way to walk to the goal.
    """
    walkable = {"pose", "places"} <= set(world.spec.channels) and "pose" in real.channels
    if is_recording(goal):
        if not walkable:
            raise PlanningError(
                f"{world.spec.name} knows no places to walk to, so the views of {goal} are no goals there."
            )
        return _near(_poses(goal), _places(world), goal)
    if not walkable or set(values) not in ({"pose"}, {"rgb"}):
        return None
    observed = with_estimated_pose({name: value[None] for name, value in values.items()}, world)
    if "pose" not in observed or not bool(torch.isfinite(observed["pose"][0, :2]).all()):
        return None
    pose, known = observed["pose"].cpu(), _places(world)
    if set(values) == {"rgb"} and len(known) and float((known - pose[:, :2]).norm(dim=1).min()) > _REACHABLE_M:
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
    """The places [N, 2] in metres where the world remembers a camera."""
    held = world.render(world.start(1, make_rng(0)), ("places",))["places"][0].cpu()
    return held[held[:, 3] > 0, :2]


def _near(poses: torch.Tensor, places: torch.Tensor, goal: str) -> torch.Tensor:
    parts = poses.float().split(4096)
    near = torch.cat([torch.cdist(part[:, :2], places).amin(1) < _REACHABLE_M / 2 for part in parts])
    if int(near.sum()) < 2:
        raise PlanningError(f"{goal} was recorded where the world has never been: no way to its views is known.")
    return poses[near].float()
