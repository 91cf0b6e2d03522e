"""Posed RGB-D pictures of rooms that nobody made for us to fit: one of Doom's, and one in MuJoCo. benchmarks/space.py fits them."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from terrella.learn.recipes.splat_views import SplatFit, read_views
from terrella.sim.mujoco_model import mujoco
from terrella.space.camera import planar_pose, rotation
from terrella.space.fitting import PosedViews

LENS, SIZE = (0.5, 0.5, 0.5, 0.5), (256, 256)
LOOKS = ("checker", "gradient", "flat")


def doom_room() -> PosedViews:
    """68 pictures of the big room of my_way_home, of which 60 are fitted: the example of docs/space.md."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["record", "doom", "--frames", "3000", "--seed", "3", "--out", f"{folder}/maze"]
        subprocess.run(
            [sys.executable, "-c", "import sys; from terrella.cli import main; sys.exit(main())", *command],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        return read_views(f"{folder}/maze", Path(folder), SplatFit(frames=68, episodes=1, box=(15.5, -9, 24, -2)))[0]


def mujoco_room(count: int = 112, seed: int = 0) -> PosedViews:
    """Pictures of a room of 6 x 5 m with a dozen things in it, drawn by MuJoCo from places at eye height."""
    model = mujoco.MjModel.from_xml_string(_room_xml(seed))
    data, renderer = mujoco.MjData(model), mujoco.Renderer(model, *SIZE)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(seed + 1)
    turn = np.linspace(0, 6 * np.pi, count)  # three ways around
    x, y = 3 + 1.1 * np.cos(turn / 3) + rng.normal(0, 0.05, count), 2.5 + 0.8 * np.sin(turn / 3)
    pose = planar_pose(*(torch.from_numpy(v).float() for v in (x, y, np.full(count, 1.5), turn * 1.37)))
    rgb, depth = [], []
    for place, turned in zip(pose.double().numpy(), rotation(pose).double().numpy()):
        data.cam_xpos[0], (ahead, left, up) = place[:3], turned.T
        data.cam_xmat[0] = np.stack([-left, up, -ahead], 1).ravel()  # MuJoCo's cameras look along -z
        renderer.update_scene(data, 0)
        rgb.append(renderer.render().copy())
        renderer.enable_depth_rendering()
        depth.append(renderer.render().copy())
        renderer.disable_depth_rendering()
    renderer.close()
    pictures = torch.from_numpy(np.stack(rgb)).permute(0, 3, 1, 2).contiguous()
    return PosedViews(pictures, torch.from_numpy(np.stack(depth)).float(), pose, LENS)


def _room_xml(seed: int) -> str:
    rng = np.random.default_rng(seed)
    colour = lambda: " ".join(f"{v:.2f}" for v in rng.uniform(0.2, 0.9, 3))  # noqa: E731
    textures = "".join(
        f'<texture name="t{k}" type="2d" builtin="{LOOKS[k % 3]}" rgb1="{colour()}" rgb2="{colour()}" width="128" height="128"/>'
        f'<material name="m{k}" texture="t{k}" texrepeat="3 3" specular="0"/>' for k in range(8)
    )  # fmt: skip
    sides = [(3, 2.5, -0.05, 3.1, 2.6, 0.05), (3, 2.5, 2.85, 3.1, 2.6, 0.05), (-0.05, 2.5, 1.4, 0.05, 2.6, 1.4),
             (6.05, 2.5, 1.4, 0.05, 2.6, 1.4), (3, -0.05, 1.4, 3.1, 0.05, 1.4), (3, 5.05, 1.4, 3.1, 0.05, 1.4)]  # fmt: skip
    geoms = [f'<geom type="box" pos="{a} {b} {c}" size="{d} {e} {f}" material="m{k}"/>'
             for k, (a, b, c, d, e, f) in enumerate(sides)]  # fmt: skip
    for k in range(12):
        turn = 2 * np.pi * k / 12
        x, y = 3 + 2.4 * np.cos(turn), 2.5 + 1.9 * np.sin(turn)
        kind, size = (("box", "0.25 0.2 0.4"), ("cylinder", "0.2 0.5"), ("sphere", "0.3"))[k % 3]
        geoms.append(f'<geom type="{kind}" pos="{x:.2f} {y:.2f} 0.4" size="{size}" material="m{6 + k % 2}"/>')
    return f"""<mujoco><visual><headlight ambient=".5 .5 .5" diffuse="0 0 0" specular="0 0 0"/><global fovy="90"/>
<map znear="0.01"/></visual>
<asset>{textures}</asset><worldbody>
<light directional="true" dir=".3 .5 -1" diffuse=".4 .4 .4" specular="0 0 0" castshadow="false"/>
<light directional="true" dir="-.5 -.3 .6" diffuse=".25 .25 .25" specular="0 0 0" castshadow="false"/>
<camera name="eye" fovy="90"/>
{"".join(geoms)}</worldbody></mujoco>"""
