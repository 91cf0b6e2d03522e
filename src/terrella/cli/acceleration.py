"""The command `terrella bench acceleration`: how much faster than time a world imagines, beside MuJoCo, and what that is worth."""

from __future__ import annotations

import statistics
from dataclasses import asdict

import numpy as np
import torch
from tyro.conf import Positional

from .. import library
from ..act.planning import PlaySettings, play
from ..act.policies_by_name import policy_of
from ..core.errors import TerrellaError
from ..core.spec import BUTTONS, CHOICE
from ..core.world import World, make_rng
from ..learn.recipes.policy import device_of
from ..measure.acceleration import EnergyMeter, Throughput, measure_throughput, usable_horizon
from ..measure.statistics import Figure, ratio_interval
from .beside import STEPS, check_alike, sound
from .evaluate import table_lines
from .named import Device, load_named
from .say import Json, Seed, result


def acceleration(
    world: Positional[str],
    beside: str | None = None,
    agent: str | None = None,
    reference: str | None = None,
    batches: tuple[int, ...] = (1, 64, 1024, 4096),
    seconds: float = 1.0,
    turns: int = 3,
    episodes: int = 50,
    device: Device = "auto",
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Time a world with fresh random actions at each control step, beside a simulator of the same task in the same run: imagined
    seconds a wall second, joules, the usable horizon, and the return that a policy which practised in it retains.

    Args:
        world: A learned world (or a simulator): what `terrella list` shows, or its path.
        beside: The simulator (mujoco:NAME), with the same actions and control step.
        agent: A policy that practised in the world, a folder; with --reference its return retained is told.
        reference: A policy that practised in the simulator beside, a folder.
        batches: Streams at once.
        seconds: Wall time of each batch size in each turn.
        turns: World and simulator take turns so many times; the median counts.
        episodes: Episodes in the simulator, of each of the two policies and of random actions.
    """
    if min(*batches, turns, episodes) < 1 or not seconds > 0:
        raise TerrellaError("--batches, --turns and --episodes are 1 or more, and --seconds is above 0.")
    if (agent is None) != (reference is None) or (agent and not beside):
        raise TerrellaError("the return retained needs all three: --agent, --reference and --beside.")
    mine = _numbers(world) if library.is_truth(world) else load_named(world, device)
    real = None if beside is None else _numbers(beside)
    for one in [mine, *([real] if real else [])]:
        if one.spec.action_mode in (BUTTONS, CHOICE) or not one.spec.forkable or not _limited(one):
            raise TerrellaError(
                f"{one.spec.name} is no world of many streams with axes that have limits; give another."
            )
    if real is not None:
        check_alike(mine.spec, real.spec)
    arms = {"world": mine, **({"beside": real} if real else {})}
    timed: dict[str, dict[int, list[Throughput]]] = {arm: {batch: [] for batch in batches} for arm in arms}
    for turn in range(turns):
        for batch in batches:
            for arm, one in arms.items():
                timed[arm][batch].append(measure_throughput(one, batch, seconds, seed + turn))
    found = {arm: [_median(paces) for paces in by.values()] for arm, by in timed.items()}
    facts = _facts(world, beside, mine, found)
    if real is not None:
        facts["usable_horizon_steps"] = _horizon(mine, real, seed)
    if agent is not None and reference is not None and real is not None:
        facts["return_retained"] = asdict(retained(real, agent, reference, episodes, seed))
    result(sound(facts), json, "\n".join(_lines(facts, found)))


def retained(real: World, agent: str, reference: str, episodes: int, seed: int) -> Figure:
    """What the agent earns in the real one beyond chance, as a share of what the reference does, from the same starts."""

    def returns(name: str) -> torch.Tensor:
        policy = policy_of(name, real.spec, real)
        steps = real.spec.max_episode_steps or STEPS
        played = play(real, policy, episodes, PlaySettings(steps), seed)
        return torch.tensor([one.reward for one in played.episodes])

    floor = returns("random")
    return ratio_interval(returns(agent) - floor, returns(reference) - floor, make_rng(seed))


def _numbers(name: str) -> World:
    if not name.startswith("mujoco:"):
        return library.load(name)
    return library.load(name, cameras=(), threads=torch.get_num_threads())


def _limited(world: World) -> bool:
    return all(bool(np.isfinite(limit).all()) for limit in world.spec.action_limits)


def _median(paces: list[Throughput]) -> Throughput:
    return Throughput(
        paces[0].batch, statistics.median(p.aggregate for p in paces), statistics.median(p.joules for p in paces)
    )


def _facts(world: str, beside: str | None, mine: World, found: dict[str, list[Throughput]]) -> dict[str, object]:
    best = {arm: max(paces, key=lambda one: one.aggregate) for arm, paces in found.items()}
    facts: dict[str, object] = {"world": world, "beside": beside, "control_step_s": mine.spec.dt_s}
    facts |= {
        "threads": torch.get_num_threads(),
        "joules": EnergyMeter().how + ("" if device_of(mine).type == "cpu" else ", without the GPU"),
    }
    facts |= {f"{arm}_paces": [{**asdict(one), "stream": one.stream} for one in paces] for arm, paces in found.items()}
    facts |= {f"{arm}_best": asdict(one) for arm, one in best.items()}
    if beside is not None:
        facts["ratio"] = best["world"].aggregate / best["beside"].aggregate
    return facts


def _horizon(mine: World, real: World, seed: int) -> dict[str, float] | str:
    if not mine.spec.observes or any(name not in real.spec.channels for name in mine.spec.observes):
        return "not measured: the world does not observe what the simulator shows"
    return asdict(usable_horizon(mine, real, real.spec.max_episode_steps or STEPS, seed=seed))


def _lines(facts: dict, found: dict[str, list[Throughput]]) -> list[str]:
    heads = ["", "streams", "imagined s / wall s", "of each stream", "J / imagined s"]
    names = {"world": facts["world"], "beside": facts["beside"]}
    rows = [
        [str(names[arm]), f"{one.batch:,}", f"{one.aggregate:,.0f}", f"{one.stream:,.2f}", f"{one.joules:.3g}"]
        for arm, paces in found.items()
        for one in paces
    ]
    lines = [*table_lines(heads, rows), ""]
    lines.append(
        f"fresh random actions every {1e3 * facts['control_step_s']:g} ms; {facts['threads']} threads; joules {facts['joules']}"
    )
    if "ratio" in facts:
        lines.insert(
            0,
            f"{facts['world']} imagines {facts['ratio']:.2f} times as fast as {facts['beside']} steps, each at its best.\n",
        )
        told = facts["usable_horizon_steps"]
        told = (
            told
            if isinstance(told, str)
            else f"{Figure(**told)} steps: so long it foretells better than standing still"
        )
        lines.append(f"usable horizon: {told}")
    part = facts.get("return_retained")
    lines.append(
        f"return retained: {Figure(**part) if part else 'not measured; give --agent, --reference and --beside'}"
    )
    return lines
