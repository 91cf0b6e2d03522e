"""The cost of a plan: the distance to a goal in any channels, or the negative reward."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from gymnasium import spaces

from ...core.errors import ObservationError, PlanningError
from ...core.spec import Spec, dtype_of, is_picture, kind_of, shape_of
from ...core.world import Observation, World, make_rng

LATENT = "latent"  # the channel in which a world compares pictures, if it has one
_UNBOUNDED = 1e6  # a channel with a wider range counts as unbounded
_TINY = 1e-12  # under a square root, for a finite gradient at 0
ENDS = ("done", "done_probability")  # a world may have one of these channels, both or none


def survival_after(seen: Observation, before: torch.Tensor | None) -> torch.Tensor | None:
    """The probability [B, N] that episodes have not ended by a step, from that `before` it (None: 1); None where nothing ends them.
    Ends of several steps accumulate, though `done` is set in none; where it is set, at a probability above one half, it is 0."""
    going = None
    if ENDS[0] in seen:
        going = 1.0 - seen[ENDS[0]].cpu().float()
    if ENDS[1] in seen:
        going = (1.0 if going is None else going) * (1 - seen[ENDS[1]].cpu())
    return going if going is None or before is None else going * before


@dataclass(frozen=True)
class Cost:
    """The cost of futures, from the channels that a world renders after each step."""

    # The channels to render.
    channels: tuple[str, ...]
    # (seen: channel -> [B, N, ...], goal: channel -> [B or 1, ...]) -> the cost of a step, float [B, N].
    step_cost: Callable[[Observation, Observation], torch.Tensor]
    # channel -> [B or 1, ...]: one goal for all episodes, or one for each.
    goal: Mapping[str, torch.Tensor] = field(default_factory=dict)
    # "sum" of all steps, "last": the terminal cost of the papers, "least": the best moment of the horizon.
    over: Literal["sum", "last", "least"] = "sum"
    # Whether steps after the end of the episode cost nothing, as rewards do; each step is weighted by the probability that it is
    # reached.
    until_done: bool = False

    def ends(self, spec: Spec) -> tuple[str, ...]:
        """The channels to render beside, which say where episodes end."""
        return tuple(name for name in ENDS if self.until_done and name in spec.channels)

    def survival(self, seen: Observation, before: torch.Tensor | None) -> torch.Tensor | None:
        """`survival_after`, where steps after the end cost nothing; else None."""
        return survival_after(seen, before) if self.until_done else None

    def expected(self, step: torch.Tensor, alive: torch.Tensor | None) -> torch.Tensor:
        """The cost [B, N] of a step that is reached with probability `alive` [B, N] (None: 1)."""
        return step if alive is None else torch.where(alive > 0, alive * step, 0.0)

    def goal_of(self, entry: int, batch: int) -> dict[str, torch.Tensor]:
        """The goal [1, ...] of one of `batch` episodes; PlanningError if there are goals for another number of episodes."""
        counts = {len(tensor) for tensor in self.goal.values()} - {1, batch}
        if counts:
            raise PlanningError(f"there are goals for {counts.pop()} episodes, and {batch} are played.")
        return {name: tensor[entry : entry + 1] if len(tensor) > 1 else tensor for name, tensor in self.goal.items()}

    def accumulate(self, total: torch.Tensor | None, step: torch.Tensor) -> torch.Tensor:
        """The cost of a future up to and including a step."""
        if total is None or self.over == "last":
            return step
        return total + step if self.over == "sum" else torch.minimum(total, step)


def negative_reward(spec: Spec) -> Cost:
    """The negative return up to the end of the episode. PlanningError for a world without the channel `reward`."""
    if "reward" not in spec.channels:
        raise PlanningError(f"{spec.name} has no reward, only {', '.join(spec.channels)}. Give another goal.")
    return Cost(("reward",), lambda seen, goal: -seen["reward"].float(), until_done=True)


def distance_to(
    world: World, goal: Mapping[str, torch.Tensor], over: Literal["sum", "last", "least"] = "sum", latent: bool = True
) -> Cost:
    """The distance to a goal: channel -> its value [*shape], or one for each episode [B, *shape]; NaN matches any number.

    A world with the channel `latent` that can observe the goal compares latents, unless `latent` is False or the goal has NaN;
    others compare the channels themselves (`distance`). ChannelError or ObservationError for a goal that does not fit.
    """
    spec = world.spec
    goals = checked_goal(spec, goal)
    whole = all(bool(torch.isfinite(tensor.float()).all()) for tensor in goals.values())
    if latent and LATENT in spec.channels and spec.observes and set(spec.observes) <= set(goals) and whole:
        with torch.no_grad():
            goals = world.render(world.observe(goals, None, make_rng(0)), (LATENT,))
    return Cost(tuple(goals), lambda seen, wanted: distance(spec, wanted, seen), dict(goals), over)


def distance(spec: Spec, goal: Observation, seen: Observation) -> torch.Tensor:
    """The mean over the channels of `goal` [B or 1, ...] of the RMS difference to `seen`, [B, N, ...] or [B, ...]: float [B, N]
    or [B]. Pictures are in shares of full brightness, bounded numbers in shares of their range, others as they are; codes of cells
    differ by 1 or not at all. NaN in a goal counts as met. Of the two quaternions of a rotation, the nearer counts."""
    total = []
    for name, wanted in goal.items():
        now = seen[name].float()
        wanted, lead = wanted.to(now.device).float(), now.ndim - wanted.ndim + 1  # 2 where there are candidates
        wanted = wanted[:, None] if lead == 2 else wanted
        if kind_of(name) == "pose":
            flipped = (now * wanted)[..., 3:].nansum(-1, keepdim=True) < 0
            now = torch.cat([now[..., :3], torch.where(flipped, -now[..., 3:], now[..., 3:])], -1)
        mask, space = ~torch.isnan(wanted), spec.channels[name]
        away = (now != wanted).float() if _holds_codes(name, space) else (now - wanted) / scale_of(space).to(now.device)
        error, mask = (each[..., None].flatten(lead) for each in (torch.where(mask, away, 0.0), mask))
        total.append((error.square().sum(-1) / mask.sum(-1).clamp_min(1) + _TINY).sqrt())
    return torch.stack(total).mean(0)


def _holds_codes(name: str, space: spaces.Space) -> bool:
    shape, bytes_alone = shape_of(space), np.issubdtype(dtype_of(space), np.integer)
    return kind_of(name) != "rgb" and len(shape) == 3 and not is_picture(shape) and bytes_alone


def scale_of(space: spaces.Space) -> torch.Tensor:
    """The divisor of a channel's differences: the range of each number if it is bounded, else 1."""
    if not isinstance(space, spaces.Box):
        return torch.ones(())
    width = space.high.astype(np.float64) - space.low.astype(np.float64)
    return torch.from_numpy(np.where(np.isfinite(width) & (width > 0) & (width < _UNBOUNDED), width, 1.0)).float()


def checked_goal(spec: Spec, goal: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The goal with a batch axis. ChannelError for a missing channel, ObservationError for a value of another shape or outside the
    channel's range."""
    if not goal:
        raise PlanningError("a goal needs at least one channel and its value.")
    spec.check_channels(goal)
    goals = {}
    for name, value in goal.items():
        space, tensor = spec.channels[name], torch.as_tensor(value)
        shape = tuple(space.shape or ())
        if tuple(tensor.shape) == shape:
            tensor = tensor[None]
        if tuple(tensor.shape[1:]) != shape or not len(tensor):
            what = "a picture (height, width, 3)" if len(shape) == 3 and shape[2] == 3 else "numbers"
            raise ObservationError(
                f"the goal for '{name}' has the shape {tuple(value.shape)}, where {spec.name} shows {what} of shape {shape}."
            )
        if isinstance(space, spaces.Box):
            low, high = (torch.from_numpy(limit.astype(np.float64)) for limit in (space.low, space.high))
            beyond = (tensor < low) | (tensor > high)
            if beyond.any():
                which = tuple(beyond.nonzero()[0].tolist())
                value, lowest, highest = (
                    float(each[at]) for each, at in ((tensor, which), (low, which[1:]), (high, which[1:]))
                )
                raise ObservationError(
                    f"the goal for '{name}' holds {value:g}, outside the range of {spec.name} there "
                    f"({lowest:g} to {highest:g}): it can never be reached."
                )
        goals[name] = tensor
    return goals
