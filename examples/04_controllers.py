"""Controllers of a few lines for Pendulum, CartPole and Acrobot: policies of your own, to be judged in a dream beside reality.

    terrella evaluate examples/04_controllers.py:swing_up examples/04_controllers.py:swing_up@0.3 \
        examples/04_controllers.py:brake idle --in RUN --real gym:Pendulum-v1

A policy may be as little as a function of what is seen, channel -> [B, ...], that gives the actions [B, ...].
"""

from __future__ import annotations

import torch

import terrella
from terrella.act.planning import PlaySettings, play


def swing_up(seen, rng):
    """Pumps energy into a pendulum until it has as much as one that stands, and catches it there."""
    cos, sin, speed = seen["observation"].unbind(1)
    angle, energy = torch.atan2(sin, cos), speed.square() / 6 + 5 * cos
    pump = torch.where(speed.abs() > 0.05, speed.sign(), 1.0) * (5 - energy).clamp(-2, 2)
    catch = -(10 * angle + 2 * speed)
    return torch.where((cos > 0.85) & (speed.abs() < 5), catch, pump).clamp(-2, 2)[:, None]


def catch_only(seen, rng):
    """Keeps a pendulum up, and can do nothing for one that hangs."""
    cos, sin, speed = seen["observation"].unbind(1)
    return -(10 * torch.atan2(sin, cos) + 2 * speed).clamp(-2, 2)[:, None]


def brake(seen, rng):
    """Brings a pendulum to rest, where it hangs."""
    return -seen["observation"][:, 2:].clamp(-2, 2)


def whirl(seen, rng):
    """Drives a pendulum round and round."""
    return 2 * torch.where(seen["observation"][:, 2:] < 0, -1.0, 1.0)


def balance(seen, rng):
    """Keeps the pole up, and the cart in the middle."""
    place, speed, angle, turning = seen["observation"].unbind(1)
    return (angle + 0.3 * turning + 0.05 * place + 0.1 * speed > 0).long()


def lean(seen, rng):
    """Pushes the cart to where the pole leans: some steps too late."""
    return (seen["observation"][:, 2] > 0).long()


def follow(seen, rng):
    """Pushes the cart to where the pole turns: the pole stays up, the cart drifts away."""
    return (seen["observation"][:, 3] > 0).long()


def pump(seen, rng):
    """Pushes an acrobot's lower link the way that it turns, so that its energy grows."""
    return 2 * (seen["observation"][:, 5] > 0).long()


def against(seen, rng):
    """Pushes an acrobot's lower link against the way that the upper one turns."""
    return 2 * (seen["observation"][:, 4] < 0).long()


def along(seen, rng):
    """Pushes an acrobot's lower link the way that the upper one turns: it never gets up."""
    return 2 * (seen["observation"][:, 4] > 0).long()


def main(episodes: int = 8) -> dict[str, float]:
    """The mean return of each controller in the real CartPole."""
    world = terrella.load("gym:CartPole-v1", rgb=False)
    found = {}
    for name in ("balance", "follow", "lean", "random"):
        policy = terrella.load_policy(name if name == "random" else f"{__file__}:{name}", world.spec)
        played = play(world, policy, episodes, PlaySettings(steps=200, sees=("observation",)))
        found[name] = sum(episode.reward for episode in played.episodes) / episodes
        print(f"{name:>8}: {found[name]:.0f} of 200 steps")
    return found


if __name__ == "__main__":
    main()
