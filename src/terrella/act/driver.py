"""RouteFollower: a scripted driver that follows the channel `route`, well or badly."""

import torch

from ..core.errors import TerrellaError
from ..core.spec import Spec
from ..core.world import Observation

ROUTE, GAP = "route", "gap"
WHEELBASE_M, AHEAD_M = 0.26, 0.55  # of the car of mujoco:car, and how far ahead it aims
SPEED, TURNING, SLOW = 1.2, 0.75, 0.35  # m/s, straight on and in turns, and the share of a turn at which it is slowest
BRAKES_M, STANDS_M = 0.9, 0.4  # gaps at which it slows down and stands
WOBBLE, KEPT = 0.35, 0.9  # rad of a bad driver's steering error, and the part of it that stays each step
HASTE = 0.9  # by which a bad driver may drive faster or slower, as a part of the speed
DREAMS, WAKES = 0.06, 0.15  # probabilities each step that a bad driver looks away, and that it looks again


class RouteFollower:
    """Steers at the route (pure pursuit, Coulter 1992), and slows down in turns and before what is in the way. quality: from 0 to
    1, drawn between these two for each episode; below 1 it wobbles, looks away, and drives at another speed.

    Its memory is float32 [B, 4]: quality, steering error in rad, whether it looks away, and its speed as a share."""

    sees = (ROUTE, GAP)

    def __init__(self, spec: Spec, quality: tuple[float, float] = (1.0, 1.0)):
        if spec.action_units != ("rad", "m/s") or not all(name in spec.channels for name in self.sees):
            raise TerrellaError(
                f"driver steers a world with the channels {ROUTE} and {GAP} by rad and m/s, as mujoco:car with the task road; "
                f"{spec.name} is none."
            )
        low, high = spec.action_limits
        self.low, self.high, self.quality = torch.from_numpy(low), torch.from_numpy(high), quality

    def begin(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        drawn, (low, high) = torch.rand(batch, 2, generator=rng), self.quality
        quality = low + (high - low) * drawn[:, 0]
        pace = 1 + HASTE * (1 - quality) * (2 * drawn[:, 1] - 1)
        return torch.stack([quality, torch.zeros(batch), torch.zeros(batch), pace], 1)

    def act(
        self, observation: Observation, memory: torch.Tensor, rng: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        route, gap = observation[ROUTE].float(), observation[GAP].float()
        quality, wobble, away, pace = memory.unbind(1)
        drawn = torch.randn(len(route), generator=rng), torch.rand(len(route), generator=rng)
        wobble = KEPT * wobble + (1 - KEPT**2) ** 0.5 * WOBBLE * (1 - quality) * drawn[0]
        away = torch.where(away > 0, drawn[1] > WAKES, drawn[1] < DREAMS * (1 - quality)).float()
        distance = route.norm(dim=2)
        aim = route[torch.arange(len(route)), (distance - AHEAD_M).abs().argmin(1)]
        curve = 2 * aim[:, 1] / aim.square().sum(1).clamp_min(1e-3)
        turn = (route[:, -1, 1].abs() / SPEED / SLOW).clamp(0, 1)
        free = ((gap - STANDS_M) / (BRAKES_M - STANDS_M)).clamp(0, 1)
        speed = pace * torch.lerp(torch.tensor(SPEED), torch.tensor(TURNING), turn) * torch.where(away > 0, 1.0, free)
        action = torch.stack([torch.atan(WHEELBASE_M * curve) + wobble, speed], 1)
        return action.clamp(self.low, self.high), torch.stack([quality, wobble, away, pace], 1)


def driver_of(text: str, spec: Spec) -> RouteFollower:
    """By "QUALITY" or "LOW-HIGH"; "" is 1."""
    low, _, high = (text or "1").partition("-")
    try:
        quality = float(low), float(high or low)
    except ValueError:
        quality = -1.0, -1.0
    if not 0 <= quality[0] <= quality[1] <= 1:
        raise TerrellaError(f"'driver:{text}': give a quality from 0 to 1, or a range of it, as in driver:0.4-1.")
    return RouteFollower(spec, quality)
