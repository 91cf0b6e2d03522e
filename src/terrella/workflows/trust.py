"""Planners, and practice, stop where a world's trust horizon ends, and say so; in latent worlds planners say so and go on."""

from collections.abc import Callable
from dataclasses import replace

from ..act.planning import SearchConfig
from ..core.spec import cuts_plans, measured_trust
from ..core.world import World
from ..learn.recipes.policy import Practice, settings_in
from ..measure.trust import forecast_trust
from .progress import Progress, silent


def search_within_trust(world: World, search: SearchConfig, progress: Progress) -> SearchConfig:
    """The search, with a horizon of at most as many moves as the world can be trusted for; as it is where `trust` is set, in a
    latent world, and in one that expects no error. search: without zeros."""
    cuts = cuts_plans(world.spec)
    if search.trust is not None or (progress is silent and not cuts):
        return search
    setting = "--trust, or trust= of the policy `plan`,"
    then = f"Its plans end there; {setting} sets another limit." if cuts else f"Its plans go on; {setting} cuts them."
    trusted = _trusted(world, search.horizon * search.block, then, progress)
    return search.within(trusted) if cuts else search


def trusted_searches(progress: Progress) -> Callable[[World, SearchConfig], SearchConfig]:
    """`search_within_trust` of one world, which forecasts, and says so, once for each search."""
    known: dict[SearchConfig, SearchConfig] = {}

    def within(world: World, search: SearchConfig) -> SearchConfig:
        if search not in known:
            known[search] = search_within_trust(world, search, progress)
        return known[search]

    return within


def practice_within_trust(world: World, practice: Practice, progress: Progress) -> Practice:
    """The same of the rollouts of practice."""
    settings, _ = settings_in(world, practice)
    if practice.trust is not None:
        return practice
    then = "Its rollouts end there; --trust sets another limit."
    steps = max(1, _trusted(world, settings.horizon, then, progress))
    return replace(practice, horizon=steps) if steps < settings.horizon else practice


def _trusted(world: World, steps: int, then: str, progress: Progress) -> int:
    """At most `steps`: the steps for which the world can be trusted. Says where that is fewer."""
    forecast, most = forecast_trust(world, steps), measured_trust(world.spec)
    trusted = min(steps, steps if most is None else most, forecast.steps if forecast else steps)
    if trusted == steps:
        return steps
    why = "there its error was measured to be half way to chance"
    if forecast and trusted != most:
        why = f"there it expects an error of {forecast.level:.2g}, half way to chance"
    progress(f"{world.spec.name} is not trusted beyond {max(1, trusted)} of {steps} steps: {why}. {then}")
    return trusted
