"""A world whose generator is the weighted mean of several that were trained from the same weights (model soups: Wortsman et
al. 2022); all else is the first one's. Students that were pulled by the truth more and less are on average better than one
that was pulled halfway.

    python recipes/average.py OUT RUN:WEIGHT RUN:WEIGHT ...
"""

from __future__ import annotations

import sys

import terrella
from terrella.learn.paired import with_generator
from terrella.worlds.folder import Learned, save_world
from terrella.worlds.history import HistoryWorld
from terrella.worlds.video import VideoWorld


def average(worlds: list[Learned], weights: list[float]) -> Learned:
    """Weights are 0 or more and need not add up to 1."""
    mixed, shares = worlds[0].generator, [weight / sum(weights) for weight in weights]
    states = [world.generator.state_dict() for world in worlds]
    mixed.load_state_dict({name: sum(s * state[name] for s, state in zip(shares, states)) for name in states[0]})
    card = {"averaged": [round(share, 3) for share in shares]}
    return with_generator(worlds[0], mixed, worlds[0].config.steps, card)


def main() -> None:
    try:
        parts = [(run, float(weight)) for run, _, weight in (part.rpartition(":") for part in sys.argv[2:])]
    except ValueError:
        sys.exit(__doc__)
    weights = [weight for _, weight in parts]
    if len(parts) < 2 or not (min(weights) >= 0 < sum(weights) < float("inf")):
        sys.exit(__doc__)
    worlds = [terrella.load(run) for run, _ in parts]
    learned = [world for world in worlds if isinstance(world, (VideoWorld, HistoryWorld))]
    makes = {str({name: tuple(t.shape) for name, t in world.generator.state_dict().items()}) for world in learned}
    if len(learned) < len(worlds) or len(makes) > 1:
        sys.exit("these are not all learned worlds with generators of one make; give runs that began from one world.")
    mean = average(learned, weights)
    save_world(mean, sys.argv[1], dict(mean.spec.card))


if __name__ == "__main__":
    main()
