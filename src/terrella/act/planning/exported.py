"""A world as the cost model of other planners: stable-worldmodel's solvers, and any that call `get_cost`."""

from collections.abc import Mapping
from typing import Any, final

import torch
from torch import nn

from ...core.errors import PlanningError
from ...core.rollouts import advance
from ...core.world import World, make_rng
from ..goal_network import GOAL, LATENT, GoalActor
from .costs import distance
from .moves import ContinuousMoves, moves_of


@final
class CostModel(nn.Module):
    """`get_cost(info, candidates)`: the distance of the ends of candidate plans to a goal picture, in the latents of `world`.

    world: observes `rgb` and has the channel `latent` and continuous actions; else PlanningError. Candidates give actions from
           -1 to 1, as a share of their limits.
    """

    def __init__(self, world: World):
        super().__init__()
        spec = world.spec
        if spec.observes != ("rgb",) or LATENT not in spec.channels or not isinstance(moves_of(spec), ContinuousMoves):
            raise PlanningError(f"{spec.name} must observe pictures alone, and have latents and continuous actions.")
        self.world, self.moves = world, moves_of(spec)
        # solvers read the dtype of parameters
        self.dtype_parameter = nn.Parameter(torch.zeros(()), requires_grad=False)

    @torch.no_grad()
    def get_cost(self, info: Mapping[str, Any], candidates: torch.Tensor) -> torch.Tensor:
        """info: `pixels` and `goal`, uint8 [B, S, T, H, W, 3], the newest last, equal for all S; candidates [B, S, M, block * D].
        Returns costs [B, S]."""
        batch, samples = candidates.shape[:2]
        rng = make_rng(0)
        begun, goal = (self.world.observe({"rgb": info[name][:, 0, -1]}, None, rng) for name in ("pixels", "goal"))
        codes = candidates.reshape(batch * samples, -1, self.moves.size).float().clamp(-1, 1)
        ended = advance(self.world, begun.fork(samples), self.moves.actions(codes), rng)
        seen = {LATENT: self.world.render(ended, (LATENT,))[LATENT].unflatten(0, (batch, samples))}
        return distance(self.world.spec, self.world.render(goal, (LATENT,)), seen)

    criterion = get_cost


@final
class ActionModel(nn.Module):
    """`get_action(info)`: a goal-conditioned policy, for stable-worldmodel's FeedForwardPolicy."""

    def __init__(self, world: World, actor: GoalActor):
        super().__init__()
        self.world, self.actor = world, actor
        self.dtype_parameter = nn.Parameter(torch.zeros(()), requires_grad=False)

    @torch.no_grad()
    def get_action(self, info: Mapping[str, Any], **more: Any) -> torch.Tensor:
        """info as in `CostModel.get_cost`, without the axis S. Returns actions [B, D]."""
        rng = make_rng(0)
        begun, goal = (self.world.observe({"rgb": info[name][:, -1]}, None, rng) for name in ("pixels", "goal"))
        seen = {LATENT: self.world.render(begun, (LATENT,))[LATENT], GOAL: self.world.render(goal, (LATENT,))[LATENT]}
        action, _ = self.actor.act(seen, self.actor.begin(len(seen[GOAL]), rng), rng)
        return action
