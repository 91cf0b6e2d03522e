"""`plan`: reaches a goal in a real environment by planning in a world, beside acting at random."""

from dataclasses import asdict
from pathlib import Path

from .plan_result import PlanResult, save_result
from .plan_study import PlanConfig, open_study, refuse
from .progress import Progress, silent
from .results import folder_name
from .skills import SkillPlanResult, plan_with_skills


def plan(
    world: str | Path, config: PlanConfig | None = None, *, progress: Progress = silent
) -> PlanResult | SkillPlanResult:
    """Plans in a world and acts in the real environment. Returns how often that reached the goal, beside acting at random.

    world: a name of `terrella list`, the path of a checkpoint, or a simulator itself (gym:CartPole-v1). The page, the film and
    plan.json are left in a folder. After Ctrl-C the result holds the episodes that are done, and `stopped` is True. TerrellaError
    where the settings do not fit the world, before anything is played.
    """
    config, name = config or PlanConfig(), str(world)
    if config.skills is not None:
        return plan_with_skills(name, config, progress=progress)
    if config.agent:
        refuse(
            config,
            f"{config.agent} acts in place of the search",
            "cost",
            "proposal",
            "watts",
            "memory_mb",
            *vars(config.search),
        )
    study = open_study(name, config, progress)
    folder = Path(config.out or f"plans/{folder_name(name)}")
    played = study.run()
    about = {"world": name, "real": config.real or name, "goal": config.goal, "within": study.within}
    about |= {"apart": config.apart, "success": config.success}
    search = {name: value for name, value in asdict(study.search).items() if value is not None}
    acting = {name: getattr(config, name) for name in ("cost", "proposal", "agent") if getattr(config, name)}
    counts = {"steps": study.steps, "episodes": config.episodes, "seed": config.seed}
    settings = {**about, **search, **acting, **counts, "solved_starts_left_out": played.planner.skipped}
    settings |= study.decision.facts() if study.decision else {}
    return save_result(study, played, settings, folder)
