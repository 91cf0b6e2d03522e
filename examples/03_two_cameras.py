"""A robot with two cameras and axes for actions, simulated by MuJoCo: an Adapter gives it the geometric route.

pip install "mujoco<4"                                          # headless: export MUJOCO_GL=egl (or osmesa)
python examples/03_two_cameras.py                               # records it, and shows what the two cameras see
terrella play gym:03_two_cameras:TwoCameras-v0                  # from examples/: drive it with sticks and sliders
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

import terrella
from terrella.core import Camera
from terrella.core.policy import Random
from terrella.core.spec import POSE, POSE_UNIT
from terrella.data import Dataset, RecordOptions, record
from terrella.sim.gymnasium import Adapter, Channel

SIZE, FOV_DEGREES, ROOM_M = (96, 128), 74.0, 4.0
FOCAL = 0.5 / math.tan(math.radians(FOV_DEGREES) / 2)  # of the height
INTRINSICS = (FOCAL * SIZE[0] / SIZE[1], FOCAL, 0.5, 0.5)
SCENE = """
<mujoco><option timestep="0.02" gravity="0 0 0"/><visual><map znear="0.01"/></visual>
  <asset><texture name="check" type="2d" builtin="checker" rgb1=".8 .7 .6" rgb2=".3 .3 .4" width="64" height="64"/>
    <texture name="brick" type="2d" builtin="checker" rgb1=".7 .4 .3" rgb2=".5 .6 .4" width="64" height="64"/>
    <material name="floor" texture="check" texrepeat="8 8"/><material name="wall" texture="brick" texrepeat="6 2"/></asset>
  <worldbody><light pos="0 0 3" castshadow="false"/>
    <geom type="plane" size="4 4 .1" material="floor"/>
    <geom type="box" pos="4.1 0 1" size=".1 4 1" material="wall"/><geom type="box" pos="-4.1 0 1" size=".1 4 1" material="wall"/>
    <geom type="box" pos="0 4.1 1" size="4 .1 1" material="wall"/><geom type="box" pos="0 -4.1 1" size="4 .1 1" material="wall"/>
    <geom type="box" pos="1.5 1 .4" size=".3 .3 .4" rgba=".9 .2 .2 1"/><geom type="cylinder" pos="-1.5 1.5 .5" size=".3 .5" rgba=".2 .4 .9 1"/>
    <body name="robot" mocap="true" pos="0 0 .5"><geom type="cylinder" size=".15 .1" rgba=".2 .2 .2 1" pos="0 0 -.3"/>
      <camera name="front" fovy="74" xyaxes="0 -1 0 0 0 1"/>
      <camera name="left" fovy="74" xyaxes="1 0 0 0 0 1"/></body>
  </worldbody></mujoco>"""  # noqa: E501


class TwoCameras(gymnasium.Env):
    """Drives at up to 1 m/s and turns at up to 1.5 rad/s in a walled room of 8 by 8 metres."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    terrella = Adapter(
        channels={
            "pose": Channel(lambda env: env.pose(), POSE, POSE_UNIT),
            "depth": Channel(lambda env: env.depth("front"), spaces.Box(0, 100, SIZE, np.float32), "m"),
            "rgb.left": Channel(lambda env: env.picture("left"), spaces.Box(0, 255, (*SIZE, 3), np.uint8)),
            "depth.left": Channel(lambda env: env.depth("left"), spaces.Box(0, 100, SIZE, np.float32), "m"),
        },
        cameras={
            "rgb": Camera(INTRINSICS, SIZE),
            "rgb.left": Camera(INTRINSICS, SIZE, "pose", (0, 0, 0, math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4))),
        },
        action_names=("drive", "turn"),
        action_units=("m/s", "rad/s"),
        action_mode="velocity",
        action_frame="body",
    )

    def __init__(self, render_mode: str | None = "rgb_array"):
        self.render_mode = render_mode
        self._model = mujoco.MjModel.from_xml_string(SCENE)
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, *SIZE)
        self._place = np.zeros(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._place = np.append(self.np_random.uniform(-0.7, 0.7, 2), self.np_random.uniform(-np.pi, np.pi))
        return self._moved(), {}

    def step(self, action):
        x, y, heading = self._place
        heading += 0.15 * float(action[1])
        x, y = x + 0.1 * float(action[0]) * np.cos(heading), y + 0.1 * float(action[0]) * np.sin(heading)
        self._place = np.array([*np.clip([x, y], -ROOM_M + 0.4, ROOM_M - 0.4), heading])
        return self._moved(), 0.0, False, False, {}

    def render(self):
        return self.picture("front")

    def close(self):
        self._renderer.close()

    def pose(self) -> np.ndarray:
        """T_world_cam [7] of the front camera."""
        x, y, heading = self._place
        return np.array([x, y, 0.5, np.cos(heading / 2), 0, 0, np.sin(heading / 2)])

    def picture(self, camera: str) -> np.ndarray:
        self._renderer.update_scene(self._data, camera)
        return self._renderer.render()

    def depth(self, camera: str) -> np.ndarray:
        """Metres along the optical axis [H, W]."""
        self._renderer.enable_depth_rendering()
        depth = self.picture(camera)
        self._renderer.disable_depth_rendering()
        return np.clip(depth, 0, 100)

    def _moved(self) -> np.ndarray:
        pose = self.pose()
        self._data.mocap_pos[0], self._data.mocap_quat[0] = pose[:3], pose[3:]
        mujoco.mj_forward(self._model, self._data)
        return self._place.copy()


gymnasium.register("TwoCameras-v0", TwoCameras)


def main(out: Path = Path("recordings/two-cameras"), frames: int = 200) -> dict[str, object]:
    world = terrella.load("gym:TwoCameras-v0", forkable=False)
    record(
        world,
        Random(world.spec, (5, 15)),
        out,
        frames,
        terrella.make_rng(0),
        options=RecordOptions(max_episode_steps=100),
    )
    world.close()
    dataset = Dataset(out)
    print(f"{dataset.length} rows in {out}, cameras {', '.join(dataset.cameras)}")
    return {"rows": dataset.length, "cameras": list(dataset.cameras)}


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*(kind(value) for kind, value in zip((Path, int), given)))
