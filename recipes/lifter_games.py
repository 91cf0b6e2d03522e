"""Pictures of Doom's maps and of MuJoCo's tables for recipes/lifter.py: depth, and the lens; what lies behind is not known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch
from PIL import Image

from terrella.core import make_rng
from terrella.sim import doom
from terrella.sim.doom import CAMERA, Doom, DoomConfig

Row = tuple[np.ndarray, np.ndarray, list[float]]  # rgb uint8 [H, W, 3], depth [H, W] in metres (0: none), lens [4]
DOOM_SIZE = (80, 128)  # of square pixels; Doom's own are 1.2 times as tall as wide
GAME = "freedoom2"
MAPS = tuple(f"MAP{number:02d}" for number in range(1, 33))
UNSEEN_MAPS = MAPS[4::6]  # kept out of training: MAP05, MAP11, ...
FARTHEST_M = 59.0
MOST_EPISODES = 8  # of a map


def doom_pictures(maps: Sequence[str], count: int, seed: int) -> Iterator[Row]:
    """Pictures from random places of maps that a random walk reaches."""
    rng = np.random.default_rng(seed)
    for number, name in enumerate(maps):
        game = Doom(DoomConfig(f"{GAME}/{name}"))
        names, each, made, part = list(game.buttons), -(-count // len(maps)), 0, 0
        while made < each and part < MOST_EPISODES:
            state, part = game.start(1, make_rng(seed * 1000 + number * 100 + part)), part + 1
            for _ in range(min(8, each - made)):
                turn, turns, steps = _walk(rng)
                for step in range(turns + steps):
                    held = [turn] if step < turns else ["MOVE_FORWARD"]
                    buttons = torch.tensor([[one in held for one in names]], dtype=torch.int8)
                    state = game.imagine(state, buttons, make_rng(0))
                seen = game.render(state, ("rgb", "depth", "done"))
                rgb, depth = seen["rgb"][0].numpy(), seen["depth"][0].numpy()
                if bool(seen["done"][0]):
                    break
                if np.median(depth) < 1.5:
                    continue
                shown = np.asarray(Image.fromarray(rgb).resize(DOOM_SIZE[::-1], Image.Resampling.BOX))
                rows = ((np.arange(DOOM_SIZE[0]) + 0.5) * depth.shape[0] / DOOM_SIZE[0]).astype(int)
                made += 1
                yield shown, np.where(depth < FARTHEST_M, depth, 0)[rows], [CAMERA[0], 0.0, 0.0, np.nan]
        game.close()


def _walk(rng: np.random.Generator) -> tuple[str, int, int]:
    """A button that turns, and how many steps it is held before one goes ahead for how many."""
    return str(rng.choice(["TURN_LEFT", "TURN_RIGHT"])), int(rng.integers(3, 40)), int(rng.integers(5, 40))


def table_model(rng: np.random.Generator) -> str:
    """A table with blocks, balls and an arm of capsules, in MJCF."""

    def colour() -> str:
        return " ".join(f"{part:.2f}" for part in (*np.clip(rng.random(3) * rng.uniform(0.5, 1.2), 0, 1), 1))

    high, wide, deep = rng.uniform(0.0, 0.9), rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.6)
    parts = [f'<geom type="plane" size="4 4 .1" pos="0 0 {-high - 0.03:.3f}" material="floor"/>']
    if high > 0.1:
        parts.append(f'<geom type="box" size="{wide:.2f} {deep:.2f} .02" pos="0 0 -.02" material="top"/>')
        for x in (-wide + 0.05, wide - 0.05):
            for y in (-deep + 0.05, deep - 0.05):
                place = f'size=".03 .03 {high / 2:.3f}" pos="{x:.3f} {y:.3f} {-high / 2 - 0.03:.3f}"'
                parts.append(f'<geom type="box" {place} rgba="{colour()}"/>')
    for _ in range(int(rng.integers(1, 9))):
        size, x, y = rng.uniform(0.015, 0.07), rng.uniform(-0.8, 0.8) * wide, rng.uniform(-0.8, 0.8) * deep
        kind = str(rng.choice(["box", "sphere", "cylinder"]))
        parts.append(f'<geom type="{kind}" size="{size:.3f} {size:.3f} {size:.3f}" pos="{x:.3f} {y:.3f} {size:.3f}" '
                     f'euler="0 0 {rng.uniform(0, 90):.0f}" rgba="{colour()}"/>')  # fmt: skip
    at, thick, tint = (
        np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 0.05]),
        rng.uniform(0.015, 0.05),
        colour(),
    )
    for _ in range(int(rng.integers(0, 4))):
        end = at + rng.normal(0, 0.15, 3) + [0, 0, 0.12]
        end[2] = max(end[2], 0.05)
        ends = " ".join(f"{part:.3f}" for part in (*at, *end))
        parts.append(f'<geom type="capsule" fromto="{ends}" size="{thick:.3f}" rgba="{tint}"/>')
        at = end
    kind, mark = str(rng.choice(["checker", "flat", "gradient"])), str(rng.choice(["none", "edge", "random"]))
    return f"""<mujoco><visual><global offwidth="128" offheight="128"/><headlight ambient=".4 .4 .4"/></visual><asset>
      <texture name="sky" type="skybox" builtin="gradient" rgb1="{colour()[:-5]}" rgb2="{colour()[:-5]}" width="64" height="384"/>
      <texture name="floor" type="2d" builtin="{kind}" mark="{mark}" rgb1="{colour()[:-5]}" rgb2="{colour()[:-5]}"
       markrgb="{colour()[:-5]}" width="128" height="128"/>
      <material name="floor" texture="floor" texrepeat="{rng.integers(1, 9)} {rng.integers(1, 9)}"/>
      <material name="top" rgba="{colour()}"/></asset>
      <worldbody><light pos="{rng.uniform(-2, 2):.1f} {rng.uniform(-2, 2):.1f} 2.5" dir="0 0 -1"
       directional="{str(rng.random() < 0.5).lower()}"/>
      {"".join(parts)}</worldbody></mujoco>"""


def table_pictures(
    models: Iterator[tuple[mujoco.MjModel, float]], count: int, rng: np.random.Generator
) -> Iterator[Row]:
    """Ten pictures of each model (and the height of its floor) from around its origin."""
    made = 0
    for model, floor in models:
        data, camera = mujoco.MjData(model), mujoco.MjvCamera()
        mujoco.mj_forward(model, data)
        shown = mujoco.Renderer(model, 128, 128)
        for _ in range(10):
            wide = rng.uniform(40, 75)
            model.vis.global_.fovy, angle, pitch = wide, rng.uniform(-180, 180), -rng.uniform(15, 65)
            camera.lookat[:], camera.distance = [*rng.uniform(-0.15, 0.15, 2), 0.05], rng.uniform(0.5, 1.6)
            camera.azimuth, camera.elevation = angle, pitch
            shown.disable_depth_rendering()
            shown.update_scene(data, camera)
            rgb = shown.render().copy()
            shown.enable_depth_rendering()
            depth = shown.render().copy()
            high = camera.lookat[2] - camera.distance * np.sin(np.radians(pitch)) - floor
            lens = [0.5 / np.tan(np.radians(wide) / 2), np.radians(pitch), 0.0, high]
            yield rgb, np.where(depth < 20, depth, 0), lens
            made += 1
        shown.close()
        if made >= count:
            return


def random_tables(rng: np.random.Generator) -> Iterator[tuple[mujoco.MjModel, float]]:
    """Models without end."""
    while True:
        model = mujoco.MjModel.from_xml_string(table_model(rng))
        yield model, float(model.geom_pos[0, 2])


def robot_tables() -> Iterator[tuple[mujoco.MjModel, float]]:
    """Terrella's own robots at tables, which training never sees."""
    for name in ("blocks", "stack"):
        model = mujoco.MjModel.from_xml_path(str(Path(doom.__file__).parent / "models" / f"{name}.xml"))
        planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        yield model, float(model.geom_pos[planes[0], 2])
