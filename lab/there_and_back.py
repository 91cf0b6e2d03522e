"""There and back: off by one action and back by another, in a game and in a world that learned it. What does the world still know?

    python lab/there_and_back.py islet gym:Islet-v0 --there left --back right --steps 100

Starts count from which the way is free: on the way back the game shows the pictures of the way there, but for what moved
meanwhile; so nothing stops one on the way. With --shown the world is shown the way there, and dreams the way back alone. PSNR in
dB, pooled, of the pixels that the game shows again (the place), and of all; --strip draws some of the starts.
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import terrella
from terrella.core import make_rng
from terrella.measure.fidelity import changes, squared_error

CONTEXT = 8  # pictures that the world is shown, nobody doing anything
MOVED = 0.12  # the share of pixels that may be others on the way back


def psnr(one: torch.Tensor, other: torch.Tensor, where: torch.Tensor | None = None) -> float:
    """dB of uint8 [..., H, W, 3] against each other, pooled over the pixels `where` bool [..., H, W]; None: over all."""
    error = squared_error(one, other)
    return float(10 * torch.log10(255**2 / (error if where is None else error[where]).mean().clamp_min(1e-6)))


def went(game, seed: int, actions: list[int]) -> torch.Tensor:
    """What the game shows from the seed's start on, uint8 [T + 1, H, W, 3]."""
    rng = make_rng(seed)
    state = game.start(1, rng)
    frames = [game.render(state, ("rgb",))["rgb"][0]]
    for action in actions:
        state = game.imagine(state, torch.tensor([action]), rng)
        frames.append(game.render(state, ("rgb",))["rgb"][0])
    return torch.stack(frames)


def dreamt(world, truth: torch.Tensor, actions: list[int], shown: int, rng: torch.Generator) -> torch.Tensor:
    """The same of a world that is shown the first `shown` pictures of truth [N, T + 1, H, W, 3]: [N, T + 1 - CONTEXT, H, W, 3]."""
    state = world.observe({"rgb": truth[:, 0]}, None, rng)
    frames = []
    for step, action in enumerate(actions, start=1):
        state = world.imagine(state, torch.full((len(truth),), action), rng)
        if step < shown:
            state = world.observe({"rgb": truth[:, step]}, state, rng)
        if step >= CONTEXT:
            frames.append(world.render(state, ("rgb",))["rgb"])
    return torch.stack(frames, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world")
    parser.add_argument("game")
    parser.add_argument("--there", required=True, help="name of an action")
    parser.add_argument("--back", required=True)
    parser.add_argument("--rest", default="noop")
    parser.add_argument("--steps", type=int, default=100, help="there and back together")
    parser.add_argument("--starts", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1000, help="of the first start that is tried")
    parser.add_argument("--shown", action="store_true", help="show it the way there; it dreams the way back alone")
    parser.add_argument("--strip", type=Path)
    args = parser.parse_args()
    if args.steps < 2 or args.starts < 1:
        parser.error("--steps takes 2 or more, --starts 1 or more.")
    world, half = terrella.load(args.world), args.steps // 2
    game = terrella.load(args.game, size=world.spec.channels["rgb"].shape[:2])
    if world.spec.action_names != game.spec.action_names:
        parser.error(
            f"{args.world} and {args.game} have other actions: a world is compared with the game that it learned."
        )
    for name in (args.rest, args.there, args.back):
        if name not in game.spec.action_names:
            parser.error(
                f"{args.game} has no action {name!r}; it has {', '.join(game.spec.action_names) or 'none with names'}."
            )
    rest, there, back = (game.spec.action_names.index(name) for name in (args.rest, args.there, args.back))
    actions = [rest] * (CONTEXT - 1) + [there] * half + [back] * half
    found, tried = [], 0
    while len(found) < args.starts and tried < 40 * args.starts:
        truth = went(game, args.seed + tried, actions)
        way = truth[CONTEXT - 1 :]
        others = changes(way[:half], way.flip(0)[:half]).double().mean((1, 2))
        found += [truth] if others.max() < MOVED and changes(way[0], way[half]).double().mean() > 0.5 else []
        tried += 1
    if not found:
        raise SystemExit(f"None of {tried} starts had a free way {args.there} and {args.back}.")
    truth = torch.stack(found)
    dream = dreamt(world, truth, actions, CONTEXT + half * args.shown, make_rng(args.seed))
    first, last = truth[:, CONTEXT - 1], truth[:, -1]
    place, end = ~changes(first, last), dream[:, -1]
    each = torch.tensor([psnr(*one) for one in zip(end, last, place)])
    print(f"{args.there} and {args.back}, {2 * half} steps: {len(truth)} of {tried} starts have a free way")
    far = psnr(dream[:, half - 1], truth[:, -1 - half])
    print(
        f"back, the place: {psnr(end, last, place):.1f} dB; each {' '.join(f'{value:.0f}' for value in each.sort().values)}"
    )
    print(f"  at 30 dB or more {int((each >= 30).sum())} of {len(each)}; half way, against the game {far:.1f} dB")
    print(f"back, all: {psnr(end, last):.1f} dB; the game's last picture against its first {psnr(last, first):.1f} dB")
    if args.strip:
        looked = [first[:8], truth[:8, -1 - half], dream[:8, half - 1], last[:8], end[:8]]
        Image.fromarray(torch.cat([torch.cat(list(row), 1) for row in looked]).numpy()).save(args.strip)


if __name__ == "__main__":
    main()
