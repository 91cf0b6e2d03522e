"""A humanoid (or a quadruped) that sees, imagines, plans and walks: camera and joints in, a learned world beside it, a plan every
second, control at 50 Hz. Watched in the browser; typed words, a picture of a post, or --to say where to walk.

    pip install 'terrella[mujoco]' && pip install --no-deps mjlab==1.6.0         # the robots' files
    python examples/05_robot.py --to blue                                        # learns its world in some minutes, once
    python examples/05_robot.py --body go1
    terrella train policy --in mujoco:g1 --minutes 20 --batch 512 --learning-rate 3e-4 --entropy 5e-3 --seed 1 --out runs/g1
                                                                                 # how the gait in g1_gait/ was made
"""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces

import terrella
from terrella.act.planning import Cost, Planner, PlannerMemory, SearchConfig, imagined_futures
from terrella.core import State, chance
from terrella.core.errors import ContractError, TerrellaError
from terrella.core.policy import Random
from terrella.data import record
from terrella.learn.recipes.latent import LatentTraining, train_latent
from terrella.serve import ServeConfig, serve
from terrella.serve.agent import Agent, Agents
from terrella.sim.mujoco_model import mujoco
from terrella.sim.mujoco_robots import ROBOTS
from terrella.sim.mujoco_tasks import rotate
from terrella.sim.mujoco_world import MujocoConfig, MujocoWorld

POSTS = {"red": (3.0, 1.2), "green": (3.5, -1.0), "blue": (-1.0, 3.0)}  # x and y, m
STEPS = 5  # control steps of 20 ms that a command lasts
NEAR_M, REACH_M = 0.7, 5.0  # where a post is reached; as far as posts are
RADIUS_M, HALF_M = 0.12, 0.6  # of a post
SIZE, FOVY = (96, 128), 70.0  # pictures; the head camera's angle


@dataclass(frozen=True)
class Body:
    """head: the part that has the camera, and eye: where, m; view: a camera that sees all of it; fastest: that it walks, m/s."""

    head: str
    eye: tuple[float, float, float]
    view: str
    fastest: float


BODIES = {
    "g1": Body("torso_link", (0.12, 0.0, 0.42), "tracking", 0.8),
    "go1": Body("trunk", (0.3, 0.0, 0.1), "side", 1.0),
}


def furnished(name: str):
    """The robot with a camera in its head, and three posts that only eyes meet."""
    robot, body = ROBOTS[name], BODIES[name]

    def adds(spec) -> None:
        robot.adds(spec)
        right_and_up = [0, -1, 0, 0, 0, 1]
        eye = spec.body(body.head).add_camera(name="head", pos=body.eye, fovy=FOVY)
        eye.alt.type, eye.alt.xyaxes = mujoco.mjtOrientation.mjORIENTATION_XYAXES, right_and_up
        for at, (x, y) in enumerate(POSTS.values()):
            post = spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=[x, y, HALF_M], size=[RADIUS_M, HALF_M, 0]
            )
            post.contype, post.conaffinity = 0, 0
            post.rgba = [0.9 if at == channel else 0.08 for channel in range(3)] + [1]

    return replace(robot, adds=adds)


class Walker:
    """A body with its gait inside: an action is a velocity forward and a turning, for a tenth of a second. Channels of numbers:
    `post` [2], m, where a post is that each episode draws, forward and left of the body; `posts` [3, 2], where those that are seen
    are; `velocity`."""

    def __init__(self, name: str, gait: Path, draws: bool = True):
        self.body = BODIES[name]
        cameras = ("head", self.body.view) if draws else ()
        self.sim = MujocoWorld(furnished(name), MujocoConfig(cameras=cameras, depth=draws, size=SIZE))
        self.gait = terrella.load_policy(str(gait), self.sim.spec)
        own = self.sim.spec
        drawn = {name: space for name, space in own.channels.items() if name.split(".")[0] in ("rgb", "depth", "pose")}
        kept = {name: own.channels[name] for name in ("velocity", "reward", "done")}
        told = {"post": free(2), "posts": free(len(POSTS), 2)}
        commands = spaces.Box(np.float32([0.3, -0.5]), np.float32([self.body.fastest, 0.5]))
        ahead = [self.body.fastest, 0]
        self.spec = replace(
            own, name="walker", action=commands, channels={**drawn, **kept, **told},
            dt_s=STEPS * own.dt_s, action_names=("forward", "turning"), action_units=("m/s", "rad/s"), action_mode="velocity",
            action_frame="body", idle=(0.3, 0.0), keys={"ArrowUp": ahead, "ArrowLeft": [0.3, 0.5], "ArrowRight": [0.3, -0.5]},
            max_episode_steps=120, units={k: v for k, v in own.units.items() if k in drawn | kept} | {"post": "m", "posts": "m"},
        )  # fmt: skip

    def start(self, batch, rng):
        state, drawn = self.sim.start(batch, rng), 2 * chance.uniform(chance.seeds(batch, rng), (2,)) - 1
        return state.replace(post=REACH_M * drawn)

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
        told = {"post": lambda: self.before(state, state["post"]), "posts": lambda: self._posts(state)}
        told["reward"] = lambda: -told["post"]().norm(dim=1)
        own = self.sim.render(state, [name for name in channels if name not in told])
        return own | {name: told[name]() for name in channels if name in told}

    def _posts(self, state):
        places = torch.tensor(list(POSTS.values()))
        return torch.stack([self.before(state, place.expand(state.batch, 2)) for place in places], 1)

    def before(self, state, place):
        """Where a place [B, 2] of the world is, forward and left of the body, m."""
        qpos = state["physics"][:, self.sim.layout.qpos]
        away = torch.cat([place.double() - qpos[:, :2], torch.zeros(state.batch, 1)], 1)
        yaw = heading(qpos[:, 3:7])
        back = torch.stack([(yaw / 2).cos(), 0 * yaw, 0 * yaw, -(yaw / 2).sin()], 1)
        return rotate(back, away)[:, :2].float()


def free(*shape: int) -> spaces.Box:
    """Numbers without limits."""
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def heading(turn):
    """Heading of quaternions w, x, y, z [B, 4], rad."""
    w, x, y, z = turn.unbind(1)
    return torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def seen_at(rgb: torch.Tensor, depth: torch.Tensor, colour: int, body: Body) -> torch.Tensor | None:
    """Where the post of a colour (0 red, 1 green, 2 blue) is, [2] m forward and left of the body, by the head camera's picture
    [H, W, 3] and depth [H, W]; None where it is not in sight."""
    other = [channel for channel in range(3) if channel != colour]
    own = (rgb[..., colour].int() - rgb[..., other].int().amax(-1)) > 50
    if own.sum() < 12:
        return None
    focal = 0.5 * len(rgb) / math.tan(math.radians(FOVY) / 2)
    right = (own.nonzero()[:, 1].float().mean() - 0.5 * (rgb.shape[1] - 1)) / focal
    ahead = depth[own].median()
    return torch.stack([ahead + body.eye[0] + RADIUS_M, -right * ahead])


def understood(words: str) -> dict[str, torch.Tensor]:
    """An instruction ("to the red post, then to the blue one") as a goal: the posts [1, n] in the order of their colours' names.
    ContractError where it names none."""
    said = re.findall(r"[a-z]+", words.lower())
    colours = [list(POSTS).index(word) for word in said if word in POSTS]
    if not colours:
        raise ContractError(f'"{words}" names no post; say, for example, "to the red post, then to the blue one".')
    return {"posts": torch.tensor([colours])}


@dataclass
class Thinking:
    """A mind's memory: what its planner remembers, and how many of its posts it has been at."""

    thoughts: list[PlannerMemory]
    reached: int = 0


class Mind:
    """Sees a post in the head's picture, remembers by the learned world where it must be while it is out of sight, and plans in
    that world once a second; then goes on to the next. Until it has seen a post it turns about."""

    sees = ("rgb", "depth", "velocity")

    def __init__(self, dream, colours: list[int], body: Body):
        cost = Cost(("post",), lambda seen, goal: seen["post"].norm(dim=-1))
        search = SearchConfig(samples=64, iterations=4, horizon=8, block=5, replan=2)
        self.dream, self.colours, self.body = dream, colours, body
        self.planner = Planner(dream, cost, search)  # two moves of half a second

    def begin(self, batch, rng):
        return Thinking(self.planner.begin(1, rng))

    def act(self, observation, memory, rng):
        colour = self.colours[memory.reached]
        post = seen_at(observation["rgb"][0], observation["depth"][0], colour, self.body)
        expected = memory.thoughts[0].prior
        if post is None and expected is None:
            return torch.tensor([[0.3, 0.5]]), memory
        there = self.dream.render(expected, ("post",))["post"] if post is None else post[None]
        if there.norm() < NEAR_M and memory.reached + 1 < len(self.colours):
            return self.act(observation, Thinking(self.planner.begin(1, rng), memory.reached + 1), rng)
        shown = {"post": there, "velocity": observation["velocity"]}
        action, thoughts = self.planner.act(shown, memory.thoughts, rng)
        return action, Thinking(thoughts, memory.reached)

    def considers(self, memory):
        """The futures of the last plan, as pictures."""
        thought, colour = memory.thoughts[0], self.colours[memory.reached]
        return imagined_futures(Sketched(self.dream, colour), self.planner.cost, thought, self.planner.config.block)


class Sketched:
    """A learned world with a picture for people, the body below and the post where it is thought to be, the wider the less sure."""

    def __init__(self, world, colour: int):
        self.world, self.colour = world, colour
        channels = {**world.spec.channels, "rgb": spaces.Box(0, 255, (*SIZE, 3), np.uint8)}
        self.spec = replace(world.spec, channels=channels)
        self.start, self.observe, self.imagine = world.start, world.observe, world.imagine

    def render(self, state, channels):
        found = self.world.render(state, [name for name in channels if name != "rgb"])
        return {name: sketch(self.world, state, [self.colour]) if name == "rgb" else found[name] for name in channels}


class Believed:
    """What the learned world believes of all posts at once, which it was shown when an episode began: for people to watch."""

    def __init__(self, world):
        self.world, self.count = world, len(POSTS)
        channels = {"posts": free(self.count, 2), "velocity": world.spec.channels["velocity"]}
        channels["rgb"] = spaces.Box(0, 255, (*SIZE, 3), np.uint8)
        self.spec = replace(world.spec, name="believed", channels=channels, observes=("posts", "velocity"), units={})

    def start(self, batch, rng):
        return self._together(self.world.start(batch * self.count, rng))

    def observe(self, observation, prior, rng):
        each = {
            "post": observation["posts"].flatten(0, 1),
            "velocity": observation["velocity"].repeat_interleave(self.count, 0),
        }
        return self._together(self.world.observe(each, None if prior is None else self._each(prior), rng))

    def imagine(self, state, action, rng):
        return self._together(self.world.imagine(self._each(state), action.repeat_interleave(self.count, 0), rng))

    def render(self, state, channels):
        each = self._each(state)
        seen = self.world.render(each, ("post", "velocity"))
        told = {"posts": seen["post"].unflatten(0, (-1, self.count)), "velocity": seen["velocity"][:: self.count]}
        return {name: sketch(self.world, each, range(self.count)) if name == "rgb" else told[name] for name in channels}

    def _together(self, state):
        return State({name: value.unflatten(0, (-1, self.count)) for name, value in state.items()})

    def _each(self, state):
        return State({name: value.flatten(0, 1) for name, value in state.items()})


def sketch(world, state, colours) -> torch.Tensor:
    """Pictures uint8 [B, H, W, 3] of B times as many states as there are colours: posts about a body that looks up."""
    seen, (height, width) = world.render(state, ("post", "uncertainty")), SIZE
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    scale, foot = height / (REACH_M + 2), 0.75 * height  # pixels a metre; the body's row
    up, left = (foot - rows) / scale, (width / 2 - columns) / scale
    picture = torch.full((state.batch // len(colours), height, width, 3), 28.0)
    for at, colour in enumerate(colours):
        post, sure = (
            value[at :: len(colours)].view(len(picture), -1, 1, 1) for value in (seen["post"], seen["uncertainty"])
        )
        away = torch.hypot(up - post[:, 0], left - post[:, 1])
        for radius, light in ((0.3 + 1.5 * sure[:, 0], 100.0), (0.2, 230.0)):
            picture[..., colour] = torch.where(away < radius, light, picture[..., colour])
    picture[torch.hypot(up, left).expand(len(picture), -1, -1) < 0.25] = 220.0
    return picture.to(torch.uint8)


def learned(name: str, gait: Path, out: Path, frames: int, steps: int):
    """The world beside the robot: what a command does to where a post is and to the speed, from recorded walks."""
    if not (out / "run" / "validation.json").exists():
        walker = Walker(name, gait, draws=False)
        record(walker, Random(walker.spec, (5, 20)), out / "walks", frames, terrella.make_rng(0), told)
        small = LatentTraining(
            "walker", channels=("post", "velocity"), history=2, hidden=96, steps=steps, leap=0, rollout=10
        )
        train_latent(out / "walks", out / "run", small, told)
    return terrella.load(out / "run")


def told(done: float, total: float, what: str = "recording") -> None:
    print(f"\r{what[:60]:60} {100 * done / max(total, 1):4.0f}%", end="", flush=True)


def agent_of(walker: Walker, dream, colours: list[int]) -> Agent:
    """Who walks from post to post. It has arrived where the last of them is near; those before it count as left to walk."""
    mind, names, left = Mind(dream, colours, walker.body), list(POSTS), list(colours)
    places = torch.tensor(list(POSTS.values()))

    def away(state) -> float:
        here = float(walker.before(state, places[left[0]][None]).norm())
        if len(left) > 1 and here < NEAR_M + 0.3:
            left.pop(0)
            return away(state)
        return here + sum(float((places[one] - places[other]).norm()) for one, other in zip(left, left[1:]))

    see = lambda state: walker.render(state, mind.sees)  # noqa: E731
    told = ", then ".join(names[colour] for colour in colours)
    return Agent(f"the mind, to {told}", mind, see, away, NEAR_M, "m", mind.considers, patience_s=30.0)


def main(
    body: str, gait: Path | None, out: Path | None, to: str, port: int, frames: int = 8000, steps: int = 2500
) -> None:
    gait, out = gait or Path(__file__).parent / f"{body}_gait", out or Path("runs") / f"robot-{body}"
    dream, walker = learned(body, gait, out, frames, steps), Walker(body, gait)

    def agent(goal) -> Agent:
        """Of an instruction its posts in order; of a goal picture its strongest colour says which post."""
        if "posts" in goal:
            return agent_of(walker, dream, goal["posts"][0].tolist())
        if "rgb" not in goal:
            return agent_of(walker, dream, [list(POSTS).index(to)])
        picture = goal["rgb"][0].float()
        return agent_of(walker, dream, [int((picture - picture.mean(-1, keepdim=True)).flatten(0, 1).amax(0).argmax())])

    agents = Agents(agent, pictures=True, words=understood, at_once=True)
    serve([walker, Believed(dream)], ServeConfig(port=port), policy=agents, on_ready=lambda at: print(f"\nopen {at}"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--body", choices=list(BODIES), default="g1", help="a humanoid, or a quadruped")
    parser.add_argument(
        "--gait", type=Path, help="folder of a policy for mujoco:BODY; default: the one beside this file"
    )
    parser.add_argument("--out", type=Path, help="where walks and world are kept; default: runs/robot-BODY")
    parser.add_argument("--to", choices=list(POSTS), default="red")
    parser.add_argument("--port", type=int, default=8765)
    try:
        main(**vars(parser.parse_args()))
    except TerrellaError as error:
        raise SystemExit(f"\n{error}") from None
    except KeyboardInterrupt:
        raise SystemExit("\nstopped; the same command goes on.") from None
