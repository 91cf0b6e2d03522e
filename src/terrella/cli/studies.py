"""The commands `plan`, `evaluate`, `transfer`, `bench acceleration` and `bench costs`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..act.planning import SearchConfig
from ..workflows.acceleration import AccelerationConfig, measure_acceleration
from ..workflows.costs import CostsConfig, measure_costs
from ..workflows.evaluate import EvaluateConfig
from ..workflows.evaluate import evaluate as run_evaluate
from ..workflows.goals import REWARD
from ..workflows.place_goals import is_recording
from ..workflows.plan import plan as run_plan
from ..workflows.plan_result import PlanResult
from ..workflows.plan_study import PlanConfig
from ..workflows.results import changed_settings, command
from ..workflows.skills import SkillPlanResult
from ..workflows.transfer import TransferConfig
from ..workflows.transfer import transfer as run_transfer
from .say import Json, WorldName, playing, say, show

Inside = Annotated[str, arg(name="in", help="The world to evaluate them in: a name of `terrella list`, or a path.")]
Policies = Annotated[
    tuple[str, ...],
    Positional,
    arg(
        metavar="[POLICY ...]",
        help="random, idle, explorer, constant:VALUE, plan, plan:samples=16,horizon=12, the folder of a learned policy, or "
        "MODULE:NAME or FILE.py:NAME of your own. NAME@0.3 takes a random action with probability 0.3.",
    ),
]
STOPPED = 130


def plan(world: WorldName, config: PlanConfig, json: Json = False) -> int:
    """Plan in a world, act in the real environment, and report how often that reached the goal, beside acting at random.

    A folder receives a page, a film of dream and reality side by side, and all figures. Ctrl-C keeps the episodes that are done.

    Args:
        world: The world to plan in: a name of `terrella list`, the path of a checkpoint, or a simulator (gym:CartPole-v1).
    """
    outcome = run_plan(world, config, progress=say)
    show(outcome, json, _evaluating(world, config, outcome))
    return STOPPED if outcome.stopped else 0


def _evaluating(world: str, config: PlanConfig, outcome: PlanResult | SkillPlanResult) -> str:
    """The command that evaluates what has acted, towards the same goal; "" where `evaluate` has no such: a walk to recorded views,
    a cost or proposals for the search, and skills with a goal in words or rollouts."""
    policy = config.agent or "plan"
    if isinstance(outcome, SkillPlanResult):
        if outcome.goal is not None or config.rollouts:
            return ""
        policy = str(config.skills)
    elif is_recording(config.goal) or config.proposal or config.cost != PlanConfig.cost:
        return ""
    elif not config.agent:
        usual = asdict(SearchConfig().filled())
        changed = [
            f"{name}={outcome.settings[name]}"
            for name in usual
            if outcome.settings.get(name, usual[name]) != usual[name]
        ]
        policy += ":" * bool(changed) + ",".join(changed)
    goal, device = (None if one == usual else one for one, usual in ((config.goal, REWARD), (config.device, "auto")))
    aim = {"goal": goal, "within": config.within, "success": config.success}
    options = {"in": world, "real": config.real, **aim, "steps": config.steps, "device": device}
    return command("terrella", "evaluate", policy, **options, **changed_settings(config.environment))


def evaluate(policies: Policies, inside: Inside, config: EvaluateConfig, json: Json = False) -> None:
    """Evaluate policies in a world and in the real environment, from the same starts: does the world rank them as reality does?

    A folder receives a page of plots and all figures. Stop with Ctrl-C at any time; the same command continues.
    """
    agent = next((name for name in policies if Path(name).is_dir()), None)
    show(run_evaluate(policies, inside, config, progress=say), json, playing(inside, agent, config.environment))


def transfer(config: TransferConfig, json: Json = False) -> None:
    """Transfer policies from a simulator to a "real" robot that differs, and measure which methods help.

    The methods are domain randomisation, system identification, and a model that is fitted to a few real episodes. A folder
    receives a page of plots and all figures. Stop with Ctrl-C at any time; the same command continues.
    """
    show(run_transfer(config, progress=say), json, command("terrella", "play", config.sim))


def acceleration(world: WorldName, config: AccelerationConfig, json: Json = False) -> None:
    """Time how fast a world imagines with a new random action at each control step, beside a simulator of the same task.

    Reports imagined seconds per second, joules, the usable horizon, and what share of the simulator-trained return a policy
    trained in the world retains.

    Args:
        world: A learned world, or a simulator: a name of `terrella list`, or a path.
    """
    following = command("terrella", "train", "policy", out="runs/policy", **{"in": world})
    show(measure_acceleration(world, config, progress=say), json, following)


def costs(world: WorldName, config: CostsConfig, json: Json = False) -> None:
    """Measure what a world costs on this machine: milliseconds, joules and memory, of a frame, of an imagined second and of
    a minute of play.

    Joules are measured by RAPL and NVML where their counters can be read; else they are estimated, and labelled so.

    Args:
        world: A name of `terrella list`, a path, or a simulator.
    """
    show(measure_costs(world, config, progress=say), json, command("terrella", "play", world))
