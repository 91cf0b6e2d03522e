"""Makes docs/images/play.webp: a few seconds inside a learned world, with the keys that are held.

    python recipes/play_animation.py docs/images/play.webp --seed 5
    python recipes/play_animation.py docs/images/islet.webp --world islet --seed 3 --seconds 8 --every 2 --quality 55

Every frame is drawn by the world from the state before it and the keys. The keys are those of act/explorer.py, and where
things move those of `shoot`.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
import torch.nn.functional as F
import tyro
from PIL import Image, ImageDraw, ImageFont
from tyro.conf import Positional

import terrella
from terrella.act.explorer import Explorer
from terrella.core.policy import act

GROUND, RAISED, LINE, INK, MUTED, HELD = "#0b0c0f", "#14161a", "#24272d", "#eceae4", "#8d9097", "#7fe3c4"
CAPS = [  # label, column, row, action
    ("W", 1, 0, "MOVE_FORWARD"), ("A", 0, 1, "MOVE_LEFT"), ("S", 1, 1, "MOVE_BACKWARD"), ("D", 2, 1, "MOVE_RIGHT"),
    ("<", 4, 1, "TURN_LEFT"), (">", 5, 1, "TURN_RIGHT"), ("Space", 4, 0, "ATTACK"),
    ("W", 1, 0, "up"), ("A", 0, 1, "left"), ("S", 1, 1, "down"), ("D", 2, 1, "right"),
]  # fmt: skip
CAP, GAP, MARGIN = 34, 4, 14


def main(
    out: Positional[Path] = Path("docs/images/play.webp"),
    world: str = "doom-corridor",
    seed: int = 5,
    skip: int = 0,
    seconds: float = 4.0,
    every: int = 2,
    scale: int = 4,
    quality: int = 74,
) -> None:
    """Args:
    skip: Steps before the first frame shown.
    every: Steps of the world from one frame to the next; the animation runs at the world's own pace.
    scale: Screen pixels per pixel of the world.
    """
    played = terrella.load(world)
    steps = round(seconds / played.spec.dt_s)
    pictures, pressed = play(played, seed, skip, steps)
    frames = [draw(picture, keys, played.spec, scale) for picture, keys in zip(pictures[::every], pressed[::every])]
    frames = looped(frames, 8)
    pause_ms = round(1000 * played.spec.dt_s * every)
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=pause_ms, loop=0, quality=quality, method=4)
    print(f"{out}: {len(frames)} frames, {len(frames) * pause_ms / 1000:.1f} s, {out.stat().st_size / 2**20:.2f} MiB")


@torch.inference_mode()
def play(world, seed: int, skip: int, steps: int) -> tuple[list[Image.Image], list[set[str]]]:
    """The world's pictures, and the names of the buttons held at each."""
    spec, rng = world.spec, terrella.make_rng(seed)
    policy, state = Explorer(spec), world.start(1, rng)
    memory, aim, pictures, pressed = policy.begin(1, rng), None, [], []
    channels = tuple(name for name in ("rgb", "depth", "pose", "things") if name in spec.channels)
    for step in range(skip + steps):
        seen = world.render(state, channels)
        if "things" in seen:
            held, aim = shoot(seen, aim)
            action = torch.tensor([[name in held for name in spec.action_names]], dtype=torch.int8)
        else:
            action, memory = act(policy, seen, memory, 1, spec, rng)
        if step >= skip:
            pictures.append(Image.fromarray(seen["rgb"][0].cpu().numpy()))
            buttons = (
                action[0].tolist()
                if action.ndim > 1
                else [number == int(action) for number in range(len(spec.action_names))]
            )
            pressed.append({name for name, on in zip(spec.action_names, buttons) if on})
        state = world.imagine(state, action, rng)
    return pictures, pressed


def shoot(seen: dict[str, torch.Tensor], aim: float | None) -> tuple[set[str], float | None]:
    """The buttons of a player who shoots at whatever stands at the height of the eye, the left one first, and else walks along
    the corridor; and the column of the picture aimed at."""
    height, width = seen["things"].shape[1:3]
    standing = (seen["things"][:, int(0.42 * height) : int(0.52 * height)] > 0).float().sum(1)
    standing = F.avg_pool1d(standing.view(1, 1, width), 9, 1, 4)[0, 0]
    if standing.max() > 1.2:
        aim = 0.3 * width if aim is None else aim
        aim = float((standing * torch.exp(-(torch.arange(width) - aim).abs() / 10)).argmax())
        off = aim - width / 2
        turn = set() if abs(off) <= 4 else {"TURN_LEFT" if off < 0 else "TURN_RIGHT"}
        return turn | ({"ATTACK"} if abs(off) < 7 else set()), aim
    w, x, y, z = seen["pose"][0, 3:].tolist()
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turn = set() if abs(yaw) < 0.08 else {"TURN_RIGHT" if yaw > 0 else "TURN_LEFT"}
    return turn | ({"MOVE_FORWARD"} if abs(yaw) < 0.5 else set()), None


def draw(picture: Image.Image, held: set[str], spec, scale: int) -> Image.Image:
    """The picture, crisply enlarged, above the keys."""
    width, height = picture.width * scale, picture.height * scale
    frame = Image.new("RGB", (width, height + 2 * CAP + GAP + 2 * MARGIN), GROUND)
    frame.paste(picture.resize((width, height), Image.Resampling.NEAREST))
    pen, font, small = ImageDraw.Draw(frame), ImageFont.load_default(15), ImageFont.load_default(13)
    for label, column, row, name in CAPS:
        if name not in spec.action_names:
            continue
        x, y, on = MARGIN + column * (CAP + GAP), height + MARGIN + row * (CAP + GAP), name in held
        wide = 2 * CAP + GAP if len(label) > 1 else CAP
        pen.rounded_rectangle((x, y, x + wide, y + CAP), 6, HELD if on else RAISED, HELD if on else LINE)
        ink, middle = (GROUND if on else INK), (x + wide / 2, y + CAP / 2)
        if label in "<>":
            tip = -7 if label == "<" else 7
            pen.polygon([(middle[0] + tip, middle[1])] + [(middle[0] - tip / 2, middle[1] + d) for d in (-6, 6)], ink)
        else:
            pen.text(middle, label, ink, font, anchor="mm")
    right, top = width - MARGIN, height + MARGIN + CAP + GAP / 2
    pen.text((right, top - 10), f"terrella play {spec.name}", INK, font, anchor="rm")
    pen.text((right, top + 12), "a neural network draws every frame", MUTED, small, anchor="rm")
    return frame


def looped(frames: list[Image.Image], over: int) -> list[Image.Image]:
    """The last frames fade into the first, so that the loop has no jolt."""
    fade = [Image.blend(frames[at - over], frames[at], (at + 1) / (over + 1)) for at in range(over)]
    return frames[over:-over] + fade


if __name__ == "__main__":
    tyro.cli(main)
