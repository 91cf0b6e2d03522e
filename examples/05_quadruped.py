"""A quadruped that sees, imagines, plans and walks: camera and joints in, a learned world beside it, a plan every second, control
at 50 Hz. Watched in the browser; a picture of a post (or --to) says which one to walk to.

    pip install 'terrella[mujoco]' && pip install --no-deps mjlab==1.6.0         # the Go1's files
    python examples/05_quadruped.py --to blue                                    # learns its world in some minutes, once
    terrella train policy --in mujoco:go1 --minutes 20 --out runs/go1            # how the gait in go1_gait/ was made
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces

import terrella
from terrella.act.planning import Cost, Planner, SearchConfig, Thought, imagined
from terrella.core import chance
from terrella.core.policy import Random
from terrella.data import record
from terrella.learn.recipes.latent import LatentTraining, train_latent
from terrella.serve import serve
from terrella.serve.agent import Agent, Agents
from terrella.sim.mujoco_model import mujoco
from terrella.sim.mujoco_robots import ROBOTS
from terrella.sim.mujoco_tasks import rotated
from terrella.sim.mujoco_world import MujocoWorld

POSTS = {"red": (3.0, 1.2), "green": (3.5, -1.0), "blue": (-1.0, 3.0)}  # x and y, m
STEPS = 5  # control steps of 20 ms that a command lasts
NEAR_M, REACH_M, RADIUS_M = 0.7, 5.0, 0.12  # where a post is reached; as far as posts are; of a post
SIZE, FOVY, EYE_M = (
    (96, 128),
    70.0,
    0.3,
)  # pictures; the head camera's angle, and how far it is before the body's middle


def furnish(spec) -> None:
    """A camera in the Go1's head, and three posts that only eyes meet."""
    ROBOTS["go1"].adds(spec)
    right_and_up = [0, -1, 0, 0, 0, 1]
    eye = spec.body("trunk").add_camera(name="head", pos=[EYE_M, 0, 0.1], fovy=FOVY)
    eye.alt.type, eye.alt.xyaxes = mujoco.mjtOrientation.mjORIENTATION_XYAXES, right_and_up
    for at, (x, y) in enumerate(POSTS.values()):
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=[x, y, 0.4], size=[RADIUS_M, 0.4, 0])
        geom.contype, geom.conaffinity = 0, 0
        geom.rgba = [0.9 if at == channel else 0.08 for channel in range(3)] + [1]


class Walker:
    """The Go1 with its gait inside: an action is a velocity forward and a turning, for a tenth of a second. `post` [2], m, is where
    the post is, forward and left of the body; each episode draws one, unless `post` names it."""

    def __init__(self, gait: Path, post: str = "", draws: bool = True):
        robot = replace(ROBOTS["go1"], adds=furnish)
        cameras = ("head", "side") if draws else ()
        self.sim = MujocoWorld(robot, cameras=cameras, depth=draws, size=SIZE)
        self.gait, self.post = terrella.load_policy(str(gait), self.sim.spec), post
        own = self.sim.spec
        free = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        drawn = {name: space for name, space in own.channels.items() if name.split(".")[0] in ("rgb", "depth", "pose")}
        kept = {name: own.channels[name] for name in ("velocity", "reward", "done")}
        commands = spaces.Box(np.float32([0.3, -0.5]), np.float32([1.0, 0.5]))
        self.spec = replace(
            own, name="walker", action=commands, channels={**drawn, **kept, "post": free},
            dt_s=STEPS * own.dt_s, action_names=("forward", "turning"), action_units=("m/s", "rad/s"), action_mode="velocity",
            action_frame="body", idle=(0.3, 0.0), keys={"ArrowUp": [1, 0], "ArrowLeft": [0.3, 0.5], "ArrowRight": [0.3, -0.5]},
            max_episode_steps=120, units={**{k: v for k, v in own.units.items() if k in {**drawn, **kept}}, "post": "m"},
        )  # fmt: skip

    def start(self, batch, rng):
        state, drawn = self.sim.start(batch, rng), 2 * chance.uniform(chance.seeds(batch, rng), (2,)) - 1
        posts = torch.tensor(POSTS[self.post]).repeat(batch, 1) if self.post else REACH_M * drawn
        return state.replace(post=posts.float())

    def observe(self, observation, prior, rng):
        return self.sim.observe(observation, prior, rng)

    def imagine(self, state, action, rng):
        action = self.spec.check_action(action, state.batch)
        state = state.replace(command=torch.stack([action[:, 0], 0 * action[:, 0], action[:, 1]], 1))
        memory = self.gait.begin(state.batch, rng)
        for _ in range(STEPS):
            joints, memory = self.gait.act(self.sim.render(state, ("observation",)), memory, rng)
            state = self.sim.imagine(state, joints, rng)
        return state

    def render(self, state, channels):
        self.spec.check_channels(channels)
        own = self.sim.render(state, [name for name in channels if name not in ("post", "reward")])
        post = self._before(state)
        return {"post": post, "reward": -post.norm(dim=1), **own}

    def _before(self, state):
        qpos = state["physics"][:, self.sim.body.qpos]
        away = torch.cat([state["post"].double() - qpos[:, :2], torch.zeros(state.batch, 1)], 1)
        yaw = heading(qpos[:, 3:7])
        back = torch.stack([(yaw / 2).cos(), 0 * yaw, 0 * yaw, -(yaw / 2).sin()], 1)
        return rotated(back, away)[:, :2].float()


def heading(turn):
    """Heading of quaternions w, x, y, z [B, 4], rad."""
    w, x, y, z = turn.unbind(1)
    return torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def seen_at(rgb: torch.Tensor, depth: torch.Tensor, colour: int) -> torch.Tensor | None:
    """Where the post of a colour (0 red, 1 green, 2 blue) is, [2] m forward and left of the body, by the head camera's picture
    [H, W, 3] and depth [H, W]; None where it is not in sight."""
    other = [channel for channel in range(3) if channel != colour]
    own = (rgb[..., colour].int() - rgb[..., other].int().amax(-1)) > 50
    if own.sum() < 12:
        return None
    focal = 0.5 * len(rgb) / math.tan(math.radians(FOVY) / 2)
    right = (own.nonzero()[:, 1].float().mean() - 0.5 * (rgb.shape[1] - 1)) / focal
    ahead = depth[own].median()
    return torch.stack([ahead + EYE_M + RADIUS_M, -right * ahead])


@dataclass
class Thinking:
    """A mind's memory: what its planner remembers, and the step."""

    thoughts: list[Thought]
    step: int = 0


class Mind:
    """Sees the post in the head's picture, remembers by the learned world where it must be while it is out of sight, and plans in
    that world once a second. Until it has seen the post it turns about."""

    sees = ("rgb", "depth", "velocity")

    def __init__(self, dream, colour: int):
        cost = Cost(("post",), lambda seen, goal: seen["post"].norm(dim=-1))
        search = SearchConfig(samples=64, iterations=4, horizon=8, block=5)
        self.dream, self.colour, self.cost = dream, colour, cost
        self.planner = Planner(dream, cost, search, replan=2)  # two moves of half a second

    def begin(self, batch, rng):
        return Thinking(self.planner.begin(1, rng))

    def act(self, observation, memory, rng):
        post = seen_at(observation["rgb"][0], observation["depth"][0], self.colour)
        expected = memory.thoughts[0].prior
        if post is None and expected is None:
            return torch.tensor([[0.3, 0.5]]), memory
        there = self.dream.render(expected, ("post",))["post"] if post is None else post[None]
        shown = {"post": there, "velocity": observation["velocity"]}
        action, thoughts = self.planner.act(shown, memory.thoughts, rng)
        return action, Thinking(thoughts, memory.step + 1)


class Sketched:
    """A learned world with a picture for people, the body below and the post where it is thought to be, the wider the less sure."""

    def __init__(self, world, colour: int):
        self.world, self.colour = world, colour
        channels = {**world.spec.channels, "rgb": spaces.Box(0, 255, (*SIZE, 3), np.uint8)}
        self.spec = replace(world.spec, channels=channels)
        self.start, self.observe, self.imagine = world.start, world.observe, world.imagine

    def render(self, state, channels):
        found = self.world.render(state, [name for name in channels if name != "rgb"])
        return {name: self._drawn(state) if name == "rgb" else found[name] for name in channels}

    def _drawn(self, state):
        seen = self.world.render(state, ("post", "uncertainty"))
        height, width = SIZE
        rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        scale, foot = height / (REACH_M + 2), 0.75 * height  # pixels a metre; the body's row
        up, left = (foot - rows) / scale, (width / 2 - columns) / scale
        away = torch.hypot(up - seen["post"][:, :1, None], left - seen["post"][:, 1:, None])
        picture = torch.full((state.batch, height, width, 3), 28.0)
        picture[torch.hypot(up, left).expand(state.batch, -1, -1) < 0.25] = 220.0
        sure = seen["uncertainty"].view(-1, 1, 1)
        for radius, light in ((0.3 + 1.5 * sure, 100.0), (0.2 + 0 * sure, 230.0)):
            picture[..., self.colour] = torch.where(away < radius, light, picture[..., self.colour])
        return picture.to(torch.uint8)


def learned(gait: Path, out: Path, frames: int, steps: int):
    """The world beside the robot: what a command does to where the post is and to the speed, from recorded walks."""
    if not (out / "run" / "world").exists():
        walker = Walker(gait, draws=False)
        record(walker, Random(walker.spec, (5, 20)), out / "walks", frames, terrella.make_rng(0), told)
        small = LatentTraining(
            "walker", channels=("post", "velocity"), history=2, hidden=96, steps=steps, leap=0, rollout=10
        )
        train_latent(out / "walks", out / "run", small, told)
    return terrella.load(out / "run")


def told(done: float, total: float, what: str = "recording") -> None:
    print(f"\r{what[:60]:60} {100 * done / max(total, 1):4.0f}%", end="", flush=True)


def main(gait: Path, out: Path, to: str, port: int, frames: int = 8000, steps: int = 2500) -> None:
    dream, names = learned(gait, out, frames, steps), list(POSTS)
    walker = Walker(gait, to)

    def agent(goal) -> Agent:
        """Of a goal picture its strongest colour says which post."""
        picture = goal["rgb"][0].float() if goal else None
        strong = (
            names.index(to)
            if picture is None
            else int((picture - picture.mean(-1, keepdim=True)).flatten(0, 1).amax(0).argmax())
        )
        mind = Mind(Sketched(dream, strong), strong)
        target = torch.tensor([POSTS[names[strong]]])
        away = lambda state: float(walker.render(state.replace(post=target), ("post",))["post"].norm())  # noqa: E731
        see = lambda state: walker.render(state, mind.sees)  # noqa: E731
        considers = lambda memory: imagined(mind.dream, mind.cost, memory.thoughts[0], mind.planner.config.block)  # noqa: E731
        return Agent(f"the mind, to {names[strong]}", mind, see, away, NEAR_M, "m", considers, patience_s=30.0)

    beside = Sketched(dream, names.index(to))
    serve(
        [walker, beside],
        port=port,
        policy=Agents(agent, pictures=True, at_once=True),
        on_ready=lambda at: print(f"\nopen {at}"),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--gait", type=Path, default=Path(__file__).parent / "go1_gait", help="folder of a policy for mujoco:go1"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/quadruped"), help="where walks and world are kept")
    parser.add_argument("--to", choices=list(POSTS), default="red")
    parser.add_argument("--port", type=int, default=8765)
    main(**vars(parser.parse_args()))
