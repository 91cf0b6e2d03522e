"""The command `terrella train policy`: practice in a world alone, and what it is worth in the real environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, cast

import torch
from tyro.conf import arg

from .. import library, progress
from ..act.actor import Actor
from ..act.belief import load_learned_policy
from ..act.planning.episodes import play
from ..core.errors import TerrellaError
from ..core.policy import Policy, Random, observed_channels
from ..core.world import World, make_rng
from ..learn.growth import Scaled
from ..learn.recipes.policy import Practice, train_policy
from ..measure.statistics import Figure, mean_interval
from .beside import STEPS, check_alike, open_copied, open_real
from .named import Device, Environment, load_named
from .say import Json, result


@dataclass(frozen=True)
class Real:
    """What the policy is tried on.

    Args:
        real: The environment to act in afterwards (gym:Pendulum-v1), beside acting at random from the same starts.
        episodes: Episodes that it plays there.
    """

    real: str | None = None
    episodes: int = 20


def policy(
    world: Annotated[str, arg(name="in")],
    out: Path,
    config: Practice,
    environment: Environment,
    tried: Real,
    recording: Annotated[str | None, arg(name="from")] = None,
    grow: bool = False,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Let a policy practise in a world alone, by the hundred episodes at once, and say what it is worth in the real environment.
    Stop it with Ctrl-C at any time; the same command continues.

    Args:
        world: The world to practise in: what `terrella list` shows, the path of a checkpoint or a run, or a simulator (gym:ID).
        out: Folder of the run: the policy, its checkpoint and a log.
        recording: A recording in whose states practice begins; default: where the world's own episodes do.
        grow: Let the ranges of --randomise grow by themselves, from nothing to what the file says, while the policy copes.
    """
    if tried.episodes < 1:
        raise TerrellaError("--episodes is a whole number from 1 up.")
    if grow and environment.randomise is None:
        raise TerrellaError("--grow lets the ranges of a file grow: say which with --randomise FILE.")
    if environment.randomise is not None and not library.is_truth(world):
        raise TerrellaError(f"{world} was learned and is as it is; --randomise is for simulators (mujoco:NAME).")
    inside = open_copied(world, environment) if library.is_truth(world) else load_named(world, device)
    outside = None if tried.real is None else open_real(tried.real, environment, inside.spec)
    if outside is not None:
        check_alike(inside.spec, outside.spec)
    with progress.shown("practising") as report:
        facts = train_policy(
            inside, world, out, config, report, recording, growing=cast(Scaled, inside) if grow else None
        )
    if outside is None:
        facts["play"] = f"terrella train policy --in {world} --out {out} --real ENVIRONMENT says what it is worth"
        return result(facts, json)
    figures = tried_out(out, inside, outside, tried.episodes, config.seed)
    plain = {name: asdict(figure) for name, figure in figures.items()}
    practised = f"{facts['practised_steps']:,} steps of practice in {facts['minutes']:.1f} minutes"
    lines = [verdict(figures, outside), *told(figures, inside), practised]
    result({"verdict": lines[0], **plain, **facts}, json, "\n".join([*lines, f"the policy: {facts['policy']}"]))


def tried_out(out: Path, inside: World, outside: World, episodes: int, seed: int) -> dict[str, Figure]:
    """The policy's returns in the environment, those of chance from the same starts, what it is better by, start by start, and what
    a learned world promised."""
    steps = outside.spec.max_episode_steps or STEPS

    def returns(world: World, policy: Policy, what: str, sees: Sequence[str] = ()) -> torch.Tensor:
        with progress.shown(what) as report:
            played = play(world, policy, episodes, steps, seed, sees=sees, report=report)
        return torch.tensor([one.reward for one in played.episodes])

    actor = load_learned_policy(out, outside.spec, inside)
    sees = [name for name in observed_channels(actor, outside.spec) if name in outside.spec.channels]
    mine = returns(outside, actor, "acting", sees)
    floor = returns(outside, Random(outside.spec), "acting at random")
    found = {"return": mine, "at random": floor, "better by": mine - floor}
    if inside.spec.observes:
        dreamer = Actor.load(out, inside.spec)
        found["promised"] = returns(inside, dreamer, "dreaming", dreamer.sees)
    return {name: mean_interval(values, make_rng(seed)) for name, values in found.items()}


def verdict(figures: Mapping[str, Figure], outside: World) -> str:
    """What came of it, in a sentence."""
    better, name = figures["better by"], outside.spec.name
    if better.low > 0:
        return f"It acts better than chance in {name}, by {better}."
    if better.high < 0:
        return f"It acts worse than chance in {name}, by {better}: the world that it practised in misleads it."
    return f"It is not seen to act better than chance in {name}: by {better}."


def told(figures: Mapping[str, Figure], inside: World) -> list[str]:
    """The figures, for people."""
    lines = [f"return {figures['return']}; at random from the same starts {figures['at random']}"]
    if "promised" in figures:
        lines.append(f"in {inside.spec.name} itself, where it practised: {figures['promised']}")
    return lines
