"""Hello, little world: open the bundled one, walk and turn in imagination, rewind, take another way, keep a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

import terrella


def main(name: str = "doom-maze", steps: int = 24, picture: str | Path = "hello.png") -> Path:
    world = terrella.load(name)
    print(f"{world.spec.name}: {world.spec.card.get('what', '')}; keys {', '.join(world.spec.keys)}")
    rng = terrella.make_rng(0)
    start = world.start(1, rng)
    strips = []
    for keys in (["KeyW"], ["KeyW", "ArrowLeft"], ["KeyW", "ArrowRight"]):  # three futures of the same moment
        action = torch.tensor([world.spec.keys[key] for key in keys]).amax(0, keepdim=True)
        seen = terrella.rollout(world, start, action.expand(steps, *action.shape), rng, ("rgb",)).observations["rgb"]
        strips.append(np.concatenate(list(seen[:: steps // 4, 0].cpu().numpy()), axis=1))
    Image.fromarray(np.concatenate(strips)).save(picture)
    print(f"{picture}: from the same start, a row each for straight on, bearing left and bearing right")
    return Path(picture)


if __name__ == "__main__":
    main()
