"""A world whose generator is the weighted mean of several that were trained from the same weights (model soups: Wortsman et
al. 2022); all else is the first one's. Students that were pulled by the truth more and less are on average better than one
that was pulled halfway.

    python lab/average.py OUT RUN:WEIGHT RUN:WEIGHT ...
"""

from __future__ import annotations

import copy
import sys

import terrella
from terrella.worlds.folder import save_world
from terrella.worlds.learned import LearnedWorld


def average(worlds: list[LearnedWorld], weights: list[float]) -> LearnedWorld:
    """Weights are 0 or more and need not add up to 1. The uncertainty is left out: it knew the errors of the old generator."""
    mixed, shares = copy.deepcopy(worlds[0].generator), [weight / sum(weights) for weight in weights]
    states = [world.generator.state_dict() for world in worlds]
    mixed.load_state_dict({name: sum(s * state[name] for s, state in zip(shares, states)) for name in states[0]})
    card = {"averaged": [round(share, 3) for share in shares], "uncertainty": None}
    return worlds[0].replaced(generator=mixed, uncertainty=None, card=card)


def main() -> None:
    try:
        parts = [(run, float(weight)) for run, _, weight in (part.rpartition(":") for part in sys.argv[2:])]
    except ValueError:
        sys.exit(__doc__)
    weights = [weight for _, weight in parts]
    if len(parts) < 2 or not (min(weights) >= 0 < sum(weights) < float("inf")):
        sys.exit(__doc__)
    worlds = [terrella.load(run) for run, _ in parts]
    learned = [world for world in worlds if isinstance(world, LearnedWorld)]
    makes = {str({name: tuple(t.shape) for name, t in world.generator.state_dict().items()}) for world in learned}
    if len(learned) < len(worlds) or len(makes) > 1:
        sys.exit("these are not all learned worlds with generators of one make; give runs that began from one world.")
    mean = average(learned, weights)
    save_world(mean, sys.argv[1])


if __name__ == "__main__":
    main()
