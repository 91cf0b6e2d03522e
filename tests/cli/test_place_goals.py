"""Goals that are places: which goals they are, a start and a view for each episode, and what is said of those that cannot be."""

from __future__ import annotations

import json

import pytest
import torch
from tests.serve.mapped import Mapped
from tests.serve.panorama import Panorama

from terrella.act.planning import Planner, SearchConfig
from terrella.act.planning.routes import NoRoute
from terrella.core.errors import ObservationError, PlanningError
from terrella.core.policy import Random
from terrella.core.world import make_rng
from terrella.data import record
from terrella.workflows import plan_study
from terrella.workflows.place_goals import PlaceGoals, views_of, walking_defaults
from terrella.workflows.plan import plan
from terrella.workflows.plan_study import PlanConfig

ANY = [torch.nan] * 5


class Recognises(Mapped):
    """Tells of each lone picture that it was taken at `x`."""

    x = 1.5

    def observe(self, observation, prior, rng):
        at = {"pose": torch.tensor([[self.x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])}
        return super().observe(at if set(observation) == {"rgb"} else observation, prior, rng)


def test_poses_and_recognised_pictures_are_places_and_other_goals_are_not():
    world, picture = Recognises(), {"rgb": torch.zeros(48, 64, 3, dtype=torch.uint8)}
    assert views_of("reward", {}, world, world.spec) is None
    at = views_of("pose=1,0", {"pose": torch.tensor([1.0, 0.0, *ANY])}, world, world.spec)
    assert at is not None and at[0, :2].tolist() == [1, 0]
    seen = views_of("a.png", picture, world, world.spec)
    assert seen is not None and seen[0, 0] == 1.5
    assert views_of("a.png", picture, Panorama(), Panorama().spec) is None, "no places are known there"
    world.x = 1000.0
    with pytest.raises(ObservationError, match="does not recognise where a.png was taken"):
        views_of("a.png", picture, world, world.spec)


def test_views_of_a_recording_are_goals_where_the_world_has_been(tmp_path):
    world, folder = Mapped(), tmp_path / "views"
    record(world, Random(world.spec, (4, 8)), folder, 60, make_rng(0))
    views = views_of(str(folder), {}, world, world.spec)
    assert views is not None and views.shape[1] == 7 and 1 < len(views) <= 60
    with pytest.raises(PlanningError, match="knows no places"):
        views_of(str(folder), {}, Panorama(), Panorama().spec)


def test_each_episode_places_to_a_view_that_is_far_enough_from_its_start():
    world = Mapped()
    views = torch.tensor([[x, 0.0, *ANY] for x in (0.1, 0.2, 1.2, 1.3)])
    places, goals = PlaceGoals(views, apart_m=1.0, within_m=0.5), []

    def walker(goal):
        goals.append(goal)
        config = SearchConfig(samples=8).filled(**walking_defaults(world.spec))
        return goal.navigator(Planner(world, goal.cost(world), config))

    played = places.play(world, walker, 3, 60, 0, world.spec.observes, ("pose",), lambda done, total: None)
    again = places.play(world, lambda goal: Random(world.spec), 3, 5, 0, (), (), lambda done, total: None)
    assert [one.success for one in played.episodes] == [True] * 3 and len(again.episodes) == 3
    assert all(goal.place[0] > 1 for goal in goals)
    assert [bool(one.seen) for one in played.episodes] == [True, False, False], "one is filmed"
    with pytest.raises(PlanningError, match="no view of that recording is 9 m"):
        PlaceGoals(views, 9.0, 0.5).play(world, walker, 1, 5, 0, (), (), lambda done, total: None)


class Lost(Random):
    """Knows no way anywhere."""

    def act(self, observation, memory, rng):
        raise NoRoute("no way is known")


def test_recorded_views_of_which_none_has_a_way_are_reported(tmp_path, monkeypatch):
    world, folder = Mapped(), tmp_path / "views"
    record(world, Random(world.spec, (4, 8)), folder, 60, make_rng(0))
    monkeypatch.setattr(plan_study, "load_named", lambda *given, **named: world)
    monkeypatch.setattr(plan_study, "walker", lambda world, search, goal: Lost(world.spec))
    config = PlanConfig(goal=str(folder), apart=0.6, episodes=2, steps=3, out=tmp_path / "plan")
    result = plan("mapped", config)
    assert "to 2 of the goals no way was known" in result.lines and result.film is None and not result.curve
    assert [one["steps"] for one in json.loads((tmp_path / "plan" / "plan.json").read_text())["played"]] == [0, 0]
