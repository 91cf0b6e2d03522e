"""Measures places built of words: how fast, whether what stops bodies is where the layout says, who gets into a wall.

python benchmarks/layout.py [--walks 1000] [--steps 120]

The truth is sampled, point by point, from the boxes of the layout, with none of the code that moves bodies: a body is blocked
where one of 60 points of its disc at one of its heights lies in a box. Beside the collider of the layout stands that read off its
Gaussians, and a body that nothing stops.
"""

from __future__ import annotations

import argparse
import math
import time

import torch

from terrella.core import make_rng
from terrella.space.fitting import decibels
from terrella.space.layout import build, parse_text
from terrella.space.occupancy import Occupancy, Walker
from terrella.space.solids import Solids
from terrella.worlds.splat import BUTTONS, SolidBoxes, SplatConfig, SplatWorld

TEXT = (
    "a long room with two pillars and a red door, two windows and stairs, and a library with a sofa, a table, four chairs, "
    "two bookshelves, a rug and a plant"
)
BODY = Walker(eye_m=1.65, step_m=0.35)


def in_a_wall(place: torch.Tensor, boxes: torch.Tensor, radius: float) -> torch.Tensor:
    """Whether any of many points of bodies at `place` [B, 3] lies in a box: bool [B]."""
    ring, turn = torch.arange(60), math.pi * (3 - math.sqrt(5))
    far = radius * ((ring + 0.5) / 60).sqrt()
    far[30:] = radius  # half of them on the rim
    disc = torch.stack([far * (ring * turn).cos(), far * (ring * turn).sin()], 1)
    found = torch.zeros(len(place), dtype=torch.bool)
    for low in torch.linspace(-BODY.eye_m + BODY.step_m + 1e-3, BODY.head_m - 1e-3, 12):
        z = place[:, 2] + low
        for dx, dy in disc:
            x, y = place[:, 0] + dx, place[:, 1] + dy
            point = torch.stack([x, y, z], 1)[:, None]
            found |= ((point > boxes[:, :3]) & (point < boxes[:, 3:])).all(2).any(1)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=120)
    given = parser.parse_args()
    build(parse_text("a tiny room", 1).layout, 1000)  # compiles what is not compiled yet
    begun, used = time.perf_counter(), time.process_time()
    heard = parse_text(TEXT, 3)
    place = build(heard.layout)
    spent = time.perf_counter() - begun, time.process_time() - used
    print(
        f"words to {len(place.gaussians):,} Gaussians: {spent[1]:.2f} s of a processor, {spent[0]:.2f} s by the clock; bar 5 s"
    )
    starts = place.starts.clone()
    starts[:, 2] += BODY.eye_m
    known = torch.ones(len(place.gaussians), dtype=torch.uint8)
    world = SplatWorld(
        "built", place.gaussians, known, starts, SplatConfig(size=(96, 128), body=BODY), objects=place.objects,
        solids=SolidBoxes(place.solids, place.bodies),
    )  # fmt: skip
    agreement(world, heard.layout.rooms, given.walks)
    walks(world, given.walks, given.steps)
    closure(world)


def agreement(world: SplatWorld, rooms, count: int) -> None:
    """How often colliders say of a place in the rooms what the layout says."""
    rng = torch.Generator().manual_seed(0)
    some = torch.rand(count, 3, generator=rng)
    rows = torch.arange(count) % len(rooms)
    low, size = (torch.tensor([getattr(room, name) for room in rooms])[rows] for name in ("at", "size"))
    at = torch.cat([(low + some * size)[:, :2], low[:, 2:] + BODY.eye_m], 1)
    truth = in_a_wall(at, world.solids, BODY.radius_m)
    seen = Occupancy.of(world.gaussians)
    for name, said in (("the layout's", Solids(world.solids).blocked(at, BODY)), ("the Gaussians'", seen.blocked(at, BODY)),
                       ("none", torch.zeros_like(truth))):  # fmt: skip
        share = float((said == truth).float().mean())
        by = 196 * (share * (1 - share) / count) ** 0.5
        print(f"collider {name:15} agrees at {100 * share:.2f}% of {count} places (+-{by:.2f}); bar 99")


def walks(world: SplatWorld, count: int, steps: int) -> None:
    """How many random walks come deeper than 5 cm into a wall."""
    rng = torch.Generator().manual_seed(1)
    state = world.start(count, make_rng(1))
    still = world.collider.boxes  # what can be pushed goes away from where it was
    leaked, free = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
    drift, heading = state["pose"][:, :3].clone(), 2 * math.pi * torch.rand(count, generator=rng)
    for step in range(steps):
        if step % 10 == 0:
            odds = torch.tensor([0.8, 0.1, 0.2, 0.2, 0.3, 0.3, 0.03, 0.1])
            action = (torch.rand(count, len(BUTTONS), generator=rng) < odds).to(torch.int8)
            heading += torch.randn(count, generator=rng) * 0.7
        state = world.imagine(state, action, make_rng(step))
        drift[:, 0] += 0.08 * heading.cos()
        drift[:, 1] += 0.08 * heading.sin()
        if step % 6 == 5:
            leaked |= in_a_wall(state["pose"][:, :3], still, BODY.radius_m - 0.05)
            free |= in_a_wall(drift, still, BODY.radius_m - 0.05)
    gone = (state["pose"][:, :2] - world.starts[0, :2]).norm(dim=1)
    print(
        f"{int(leaked.sum())} of {count} random walks of {steps} steps enter a wall (they end {gone.mean():.1f} m away); bar 0.5%"
    )
    print(f"{int(free.sum())} of {count} do where nothing stops bodies")
    if world.things:
        pushed = (state["bodies"] - world.rigid.rest)[..., :3].norm(dim=2) > 0.05
        low = float(state["bodies"][..., 2].min())
        print(
            f"{int(pushed.any(1).sum())} of them pushed one of {len(world.things)} things, none of which is below {low:.2f} m"
        )


def closure(world: SplatWorld) -> None:
    """Pictures after a way out and the same way back, beside those of the way's end."""
    from terrella.space.camera import planar_pose

    one = torch.tensor([3.0])
    pose = planar_pose(one, torch.tensor([0.0]), torch.tensor([BODY.eye_m]), torch.tensor([0.3]))
    first = world.observe({"pose": pose}, None, make_rng(0))
    state, found = first, []
    for names in (
        ("TURN_LEFT", 30),
        ("MOVE_FORWARD", 20),
        ("", 25),
        ("MOVE_BACKWARD", 20),
        ("", 25),
        ("TURN_RIGHT", 30),
        ("", 25),
    ):
        action = torch.tensor([[int(button == names[0]) for button in BUTTONS]], dtype=torch.int8)
        for _ in range(names[1]):
            state = world.imagine(state, action, make_rng(0))
        found.append(state)
    shown = lambda state: world.render(state, ("rgb",))["rgb"].float()  # noqa: E731
    back, away = (float(decibels(shown(one) - shown(first))) for one in (found[-1], found[1]))
    print(f"closure {back:.1f} dB after 175 steps out and back (away from there {away:.1f}); bar 30")


if __name__ == "__main__":
    main()
