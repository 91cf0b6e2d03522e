"""The result of `plan`: figures of the episodes, sentences about them, a page, and a film of dream and reality side by side."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ..act.planning import PlayedEpisode, distance
from ..core.files import write_json
from ..core.world import make_rng, without_end
from ..measure.plan_page import compute_chart, film, film_strip, plan_page
from ..measure.policy_evaluation import percent
from ..measure.statistics import Figure
from .compute_curve import CurvePoint, conclusion, figures_of, gain
from .plan_study import PlannedEpisodes, PlanStudy
from .real_environment import comparable_channels
from .results import jsonable


@dataclass(frozen=True)
class PlanResult:
    """How often planning reached the goal, beside acting at random from the same starts."""

    lines: tuple[str, ...]  # Sentences for people, the verdict first.
    settings: Mapping[str, Any]  # World, goal, search and episodes, with their defaults filled in.
    planner: Mapping[str, Figure]  # success (where it is judged), return, steps, `ms a decision` and `steps imagined`.
    random: Mapping[str, Figure]  # The same of random actions; empty if it was stopped before.
    difference: Mapping[str, Figure]  # Success or return of the planner less that of random actions, start by start.
    curve: tuple[CurvePoint, ...]  # The planner with ever more compute.
    episodes: tuple[PlayedEpisode, ...]  # The planner's episodes.
    divergence: Mapping[str, Sequence[float]]
    """channel -> distance of the dream from reality, by step of the filmed episode."""
    page: Path  # All of it to look at.
    film: Path | None  # Dream and reality side by side; None where there are no pictures.
    stopped: bool = False  # Whether Ctrl-C ended it early.

    def to_json(self) -> dict[str, Any]:
        arms = {name: _plain(getattr(self, name)) for name in ("planner", "random", "difference")}
        seed, ends = self.settings["seed"], {"stopped": self.stopped, "page": self.page, "film": self.film or ""}
        figures = [_plain(figures_of(point.played, seed)) for point in self.curve]
        curve = [{"with": one.label, "imagined": one.imagined, **row} for one, row in zip(self.curve, figures)]
        return jsonable({**self.settings, **arms, "curve": curve, **ends})

    def summary(self) -> str:
        return "\n".join([*self.lines, f"the page: {self.page}"])


def save_result(study: PlanStudy, played: PlannedEpisodes, settings: Mapping[str, Any], folder: Path) -> PlanResult:
    """Writes the page, the film and plan.json."""
    seed, episodes = study.config.seed, played.planner.episodes
    planner, random = figures_of(played.planner, seed), {} if played.random is None else figures_of(played.random, seed)
    measure = "success" if "success" in planner else "return"
    difference = None if played.random is None else gain(played.planner, played.random, measure, seed)
    lines = [*_verdict(study, difference), *_lines(study, played, planner, random)]
    folder.mkdir(parents=True, exist_ok=True)
    seen = None if played.stopped else next((one for one in episodes if one.seen), None)
    divergence, strip, name = ({}, None, "") if seen is None else _film(study, seen, folder)
    curve = [(point.imagined, point.score) for point in played.curve]
    chart = compute_chart(curve, random[measure], measure) if curve else ""
    arms = {"planner": planner, **({"random": random} if random else {})}
    page = plan_page(f"{settings['world']}: {settings['goal']}", lines, arms, chart, strip, name, settings)
    (folder / "plan.html").write_text(page, encoding="utf-8")
    result = PlanResult(
        lines=tuple(lines),
        settings=settings,
        planner=planner,
        random=random,
        difference={} if difference is None else {measure: difference},
        curve=played.curve,
        episodes=tuple(episodes),
        divergence=divergence,
        page=folder / "plan.html",
        film=folder / name if name else None,
        stopped=played.stopped,
    )
    facts = {**result.to_json(), "divergence": divergence, "played": [_episode(episode) for episode in episodes]}
    write_json(folder / "plan.json", jsonable(facts))
    return result


def _verdict(study: PlanStudy, difference: Figure | None) -> list[str]:
    """One sentence: better than random actions from the same starts, worse, or neither for certain."""
    if difference is None:
        return []
    who = f"The policy {study.config.agent}" if study.config.agent else "Planning in this world"
    if difference.low > 0:
        return [f"{who} does better than random actions."]
    if difference.high < 0:
        return [f"{who} does worse than random actions."]
    return [f"{who} is not seen to do better than random actions; more --episodes may tell."]


def _lines(
    study: PlanStudy, played: PlannedEpisodes, planner: Mapping[str, Figure], random: Mapping[str, Figure]
) -> list[str]:
    """The outcome, for people."""
    lines, episodes = [], played.planner.episodes
    if "success" in planner:
        beside = f"; at random {percent(random['success'])}" if random else ""
        lines.append(f"reached in {percent(planner['success'])} of {len(episodes)} episodes{beside}")
    if "reward" in study.real.spec.channels or not lines:
        beside = f"; at random {random['return']}" if random else ""
        lines.append(f"return {planner['return']}{beside}")
    if unreachable := sum(not one.steps for one in episodes):
        lines.append(f"to {unreachable} of the goals no way was known")
    if ms := planner.get("ms a decision"):
        imagined = f" for {planner['steps imagined'].value:,.0f} imagined steps" if "steps imagined" in planner else ""
        lines.append(f"a decision takes {ms.value:.0f} ms (95% within {ms.high:.0f}){imagined}")
    moves = [count for one in episodes for count in one.trusted]
    whole = max((one.decision.considered.shape[1] for one in episodes if one.decision), default=0)
    if min(moves, default=whole) < whole:
        mean, setting = sum(moves) / len(moves), "trust= of the policy" if study.config.agent else "--trust"
        lines.append(
            f"plans were cut to {mean:.1f} of {whole} moves on average, where the world's uncertainty passes its limit; "
            f"{setting} sets the limit, and too short plans may be worse than uncertain ones"
        )
    lines += study.decision.lines() if study.decision else []
    if skipped := played.planner.skipped:
        lines.append(f"{skipped} starts were already solved and left out")
    if (study.goal or study.places) and planner.get("success") and not planner["success"].value and not played.cut:
        lines.append(_never_reached(study, episodes))
    measure = "success" if "success" in planner else "return"
    curve = played.curve
    lines += [f"{one.imagined:>10,.0f} imagined steps, {one.label}: {measure} {one.score}" for one in curve]
    if len(played.curve) > 1:
        lines.append(conclusion(played.curve, measure, study.config.seed))
    if study.search.budget_ms is not None:
        lines.append("planned by the clock: another run may differ")
    if played.cut:
        lines.append(f"stopped: these are the first {played.cut} of at most {study.steps} steps of each episode")
    elif played.stopped:
        lines.append(f"stopped: {len(episodes)} of {study.config.episodes} episodes are done")
    return lines


def _never_reached(study: PlanStudy, episodes: Sequence[PlayedEpisode]) -> str:
    nearest, best = min(one.nearest for one in episodes), min(one.best_cost for one in episodes)
    measured = study.criterion.goal or study.places
    away = f"; the nearest that it came is {nearest:.3g} (asked: {study.within:g})" if measured else ""
    cost = f"; the best plan in the world cost {best:.3g}" if math.isfinite(best) else ""
    return f"the goal was never reached{away}{cost}: it may be impossible"


def _plain(figures: Mapping[str, Figure]) -> dict[str, object]:
    return {name: asdict(figure) for name, figure in figures.items()}


def _episode(episode: PlayedEpisode) -> dict[str, object]:
    facts = {"steps": episode.steps, "return": episode.reward, "success": episode.success, "nearest": episode.nearest}
    return {**facts, "ended": episode.ended, "best_cost": episode.best_cost}


@torch.no_grad()
def _film(
    study: PlanStudy, episode: PlayedEpisode, folder: Path
) -> tuple[dict[str, list[float]], Image.Image | None, str]:
    """The dream of an episode, from its first observation under its actions: the divergence in each channel, a strip of dream and
    reality, and the name of the film, "" where there are no pictures."""
    seen, names = episode.seen, comparable_channels(study.world.spec, study.real.spec)
    shown = tuple(name for name in (*names, *study.pictures) if name in study.world.spec.channels)
    rng, dream = make_rng(study.config.seed), []
    state = study.world.observe({name: seen[0][name][None] for name in study.sees}, None, rng)
    for action in [*episode.actions, None]:
        dream.append({name: value[0].cpu() for name, value in study.world.render(state, shown).items()})
        state = state if action is None else study.world.imagine(without_end(state), action[None], rng)
    divergence = {}
    for name in names:
        one, other = (torch.stack([frame[name] for frame in frames]) for frames in (seen, dream))
        divergence[name] = distance(study.real.spec, {name: one}, {name: other}).tolist()
    if "rgb" not in seen[0]:
        study.progress("No film: the environment shows no pictures.")
        return divergence, None, ""
    rows = {"reality": torch.stack([frame["rgb"] for frame in seen]).numpy()}
    if "rgb" in shown:
        height, width = rows["reality"].shape[1:3]
        frames = [Image.fromarray(frame["rgb"].numpy()).resize((width, height)) for frame in dream]
        rows["dream"] = np.stack([np.asarray(frame) for frame in frames])
    first = next(iter(sorted(names, key=lambda name: name == "rgb")), "")
    curve = divergence[first] if first else [0.0] * len(seen)
    film(folder / "plan.mp4", rows, curve, f"divergence in {first}" if first else "", 1 / study.real.spec.dt_s)
    return divergence, film_strip(rows), "plan.mp4"
