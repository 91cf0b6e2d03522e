"""Skills learned from long recordings: segments by instruction, their ends, and plans of several steps, from the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.learn.stopping import quiet
from tests.learn.test_imitation import COLOURS, QUICK, teacher

import terrella
from terrella.act.imitation import load_imitation_network
from terrella.act.skills.actor import SkillActor
from terrella.act.skills.library import SkillLibrary
from terrella.act.skills.phrases import Phrase
from terrella.act.skills.search import SkillSearch
from terrella.cli import main
from terrella.core.errors import PlanningError, TrainingError
from terrella.core.world import make_rng
from terrella.data import record
from terrella.learn.demonstrations import DemonstrationRows
from terrella.learn.recipes.imitation import Imitation, open_demonstrations, train_imitation
from terrella.learn.recipes.skills import Segments, SkillRows, _skill, lasting
from terrella.sim.gymnasium import GymnasiumWorld
from terrella.workflows.page_agents import PageAgents
from terrella.workflows.skills import SkillEpisode, SkillPlanResult

NAME = "gym:tests.learn.test_skills:TerrellaErrands-v0"
BOTH = "gym:tests.learn.test_skills:TerrellaBoth-v0"


class Errands(gymnasium.Env):
    """Two of seven cells hold a code; the mission names the one to step on, and then the other. Three errands are an episode."""

    action_space = spaces.Discrete(3)  # left, stay, right
    observation_space = spaces.Dict({"grid": spaces.Box(0, 9, (1, 7, 1), np.uint8), "mission": spaces.Text(80)})
    metadata = {"render_modes": ["ansi"], "render_fps": 10}
    errands, words = 3, "go to the {} ball"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cells = self.np_random.permutation([0, 6])  # of red and blue
        self.first, self.done = int(self.np_random.integers(2)), 0
        self.at, self.steps = int(self.np_random.integers(2, 5)), 0
        return self.seen(), {}

    def step(self, action):
        self.at, self.steps = int(np.clip(self.at + int(action) - 1, 0, 6)), self.steps + 1
        self.done += int(self.at == self.cells[(self.first + self.done) % 2])
        over = self.done == self.errands
        return self.seen(), float(over), over, self.steps >= 40, {}

    def seen(self):
        grid = np.zeros((1, 7, 1), np.uint8)
        grid[0, self.cells, 0] = (3, 5)
        grid[0, self.at, 0] += 1
        at = self.first + (min(self.done, 2) if self.errands == 3 else 0)
        return {"grid": grid, "mission": self.words.format(COLOURS[at % 2], COLOURS[(at + 1) % 2])}


class Both(Errands):
    """One mission of two steps."""

    errands, words = 2, "go to the {} ball, then go to the {} ball"


for name, kind in {"TerrellaErrands-v0": Errands, "TerrellaBoth-v0": Both}.items():
    if name not in gymnasium.registry:
        gymnasium.register(name, kind)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """(the folder of a library, the recording that it is from, the policy, what learning printed)"""
    folder = tmp_path_factory.mktemp("skills")
    world = GymnasiumWorld(Errands)
    record(
        world, terrella.load_policy(f"{teacher.__module__}:teacher", world.spec), folder / "recording", 600, make_rng(0)
    )
    imitation = Imitation(remember=16)
    train_imitation(folder / "recording", folder / "run", replace(QUICK, steps=120), imitation, quiet)
    return folder / "library", folder / "recording", folder / "run"


def learned(library, *further):
    out, recording, policy = library
    words = [
        "skills",
        "learn",
        str(recording),
        "--policy",
        str(policy),
        "--out",
        str(out),
        "--steps",
        "150",
        "--batch",
        "32",
    ]
    return main([*words, *further])


def test_skills_are_learned_from_long_recordings_and_planned_with(library, capsys):
    opened, _ = open_demonstrations(library[1], ("grid",), (64, 64), quiet)
    segments = Segments.of(opened)
    assert len(segments.first) > 2.5 * len(opened.cache.episodes) and segments.success[:-1].all()
    config = load_imitation_network(library[2] / "policy")[0].config
    rows = DemonstrationRows.of(opened, replace(config, remember=0, history=1, chunk=3), torch.device("cpu"))
    assert segments.end[0] == segments.first[1], "the first errand of an episode"
    weight = rows.at(segments.end[:1] - np.array([3, 2, 1])).weight
    assert weight.tolist() == [[1, 1, 1], [1, 1, 0], [1, 0, 0]], "what follows is of another instruction"
    assert learned(library, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert [one["phrase"] for one in facts["skills"]] == ["go to the blue|red ball"]
    assert facts["ends_recognised"] > 0.9 and facts["ended_too_early"] < 0.1
    folder = str(library[0])
    assert main(["plan", BOTH, "--skills", folder, "--episodes", "12", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["rewarded"]["value"] > 0.8 and len(result["episodes"][0]["events"]) >= 3
    assert main(["plan", BOTH, "--skills", folder, "--episodes", "2", "--rollouts", "2"]) == 0
    assert ", 100% of its rollouts end" in capsys.readouterr().out
    goal = "go to the blue ball, then go to the red ball, then go to the blue ball"
    assert main(["plan", NAME, "--skills", folder, "--goal", goal, "--episodes", "3"]) == 0
    assert "go to the blue ball, then go to the red ball" in capsys.readouterr().out
    assert (
        main(
            [
                "evaluate",
                folder,
                "--in",
                BOTH,
                "--success",
                "reward",
                "--episodes",
                "8",
                "--json",
                "--out",
                folder + "/e",
            ]
        )
        == 0
    )
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows["library"]["dream"]["value"] > 0.8


@pytest.mark.parametrize("steps, least", [([20, 24, 26, 28, 30], 23), ([2, 9, 20, 30, 40], 2)])
def test_an_instruction_that_lasts_as_long_each_time_is_not_over_sooner(steps, least):
    count, lengths = len(steps), np.array(steps)
    zero, won = np.zeros(count, np.int64), np.ones(count, bool)
    skill = _skill(Phrase((("go",),)), "go", np.array([0]), Segments(zero, lengths, zero, won, ~won))
    assert (skill.least_steps, skill.steps) == (least, np.median(steps))


def test_what_looks_done_for_a_moment_is_told_from_what_stays_so():
    none = -torch.inf
    looks = torch.tensor([[0.0, 5, 1, 4, 4, none], [2, 2, 2, none, none, none]])
    assert lasting(looks, 4).tolist() == [[5, 2], [4, 2], [1, 2], [1, none]]
    assert lasting(looks[:, :1], 3).tolist() == [[0, 2], [none, none], [none, none]]


def test_an_instruction_is_over_when_it_has_looked_done_for_long_enough(library):
    """The same episode: the library that asks for three moments in a row goes on two steps later than that which asks for one."""
    assert learned(library) == 0
    world, once = GymnasiumWorld(Both), SkillLibrary.load(library[0])
    steps = []
    for hold in (1, 3):
        actor, rng = SkillActor(replace(once, hold=hold), world.spec), make_rng(0)
        state, memory, at = world.start(1, make_rng(5)), actor.begin(1, rng), 0
        while not memory[0].at and at < 30:
            action, memory = actor.act(world.render(state, actor.sees), memory, rng)
            state, at = world.imagine(state, action, rng), at + 1
        steps.append(at)
    assert steps[1] == steps[0] + 2 < 30


def test_what_the_recording_does_next_is_likelier_than_what_it_never_does_next(library):
    """Errands alternate: after the red ball comes the blue one, and it always works."""
    assert learned(library) == 0
    search = SkillSearch(SkillLibrary.load(library[0]))
    red, blue = (f"go to the {colour} ball" for colour in ("red", "blue"))
    for one, other in ((red, blue), (blue, red)):
        assert search.after(one, other).probability > 0.9 > 0.5 > search.after(one, one).probability


def test_a_batch_that_the_memory_does_not_hold_is_halved(library, monkeypatch, tmp_path):
    sample = SkillRows.sample

    def short(rows: SkillRows, count: int, rng: np.random.Generator):
        if count > 12:
            raise MemoryError
        return sample(rows, count, rng)

    monkeypatch.setattr(SkillRows, "sample", short)
    with pytest.warns(UserWarning, match="training goes on") as warned:
        assert learned((tmp_path, *library[1:])) == 0
    assert [str(one.message).split("halved to ")[1].split(",")[0] for one in warned] == ["16", "8"]


def test_a_skill_is_renamed_tried_and_listed(library, capsys):
    assert learned(library) == 0
    folder = str(library[0])
    assert main(["skills", "rename", folder, "go to the _ ball", "walk"]) == 0
    assert main(["skills", "try", folder, "walk", "--in", NAME, "--episodes", "4"]) == 0
    assert "'walk' works in" in capsys.readouterr().out
    assert main(["skills", "add", folder, "both", "go to the red ball, go to the blue ball"]) == 0
    assert main(["skills", "list", folder]) == 0
    shown = capsys.readouterr().out
    assert "walk" in shown and "'both' stands for: go to the red ball, go to the blue ball" in shown
    assert main(["plan", NAME, "--skills", folder, "--goal", "both", "--episodes", "1", "--steps", "2"]) == 0
    assert "go to the blue ball" in capsys.readouterr().out
    for words, said in (
        (["add", folder, "more", "go to the purple ball"], "do not know 'purple'"),
        (["add", folder, "walk", "go to the red ball"], "no free name"),
        (["list", str(library[1])], "holds no skills; make a library"),
        (["try", folder, "walk", "--in", NAME, "--episodes", "0"], "--episodes is 1 or more"),
    ):
        assert main(["skills", *words]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, said",
    [
        (["--goal", "go to the crimson ball"], "do not know 'crimson'"),
        (["--goal", "go"], "no skill does 'go'"),
        (["--rollouts", "-1"], "--rollouts is 0 or more"),
        (["--episodes", "0"], "--episodes and --steps are whole numbers from 1 up"),
        (["--goal", "go to the red ball", "--proposal", "x"], "--proposal: plans of skills have no use"),
    ],
)
def test_goals_that_no_skill_reaches_are_refused_before_acting(library, words, said, capsys):
    assert learned(library) == 0
    assert main(["plan", NAME, "--skills", str(library[0]), *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "goal, words",
    [
        ("there.png", "shows no pictures; give a state, or CHANNEL=VALUE"),
        ("grid=3", "the goal for 'grid' has 1 numbers, where"),
        ("reward=1", "the skills do not see 'reward'; they see grid"),
        ("shape=1", "'shape'"),
    ],
)
def test_an_observation_that_is_no_goal_is_named(goal, words, library, capsys):
    assert learned(library) == 0
    assert main(["plan", NAME, "--skills", str(library[0]), "--goal", goal]) == 2
    assert words in capsys.readouterr().err


def test_an_observation_is_a_goal_of_skills(library, tmp_path, capsys):
    """To stand on the blue ball in the last cell, whatever else is seen: of the starts those with the blue ball there reach it."""
    assert learned(library) == 0
    cells = [[[None]] * 6 + [[6]]]
    (tmp_path / "goal.json").write_text(json.dumps(cells))
    words = ["plan", NAME, "--skills", str(library[0]), "--goal", f"grid={tmp_path / 'goal.json'}", "--episodes", "8"]
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    world = GymnasiumWorld(Errands)
    blue = [bool(world.render(world.start(1, make_rng(n)), ("grid",))["grid"][0, 0, 6, 0] == 5) for n in range(8)]
    assert [one["finished"] for one in result["episodes"]] == blue and 0 < sum(blue) < 8


def test_episodes_that_begin_at_the_goal_are_counted():
    here, there = SkillEpisode(("reached",), True, 0.0, 0), SkillEpisode(("a", "b"), True, 0.0, 9)
    said = SkillPlanResult("grid=1", (here, there), within=0.05).summary()
    assert said.startswith("The goal, grid=1 within 0.05, was reached in 1 [") and "1 of 2 began at it." in said


def test_a_library_is_not_written_over_something_else(library, capsys):
    out, recording, policy = library
    for other, what in ((recording, "a recording"), (policy, "another policy"), (policy / "policy", "another policy")):
        assert learned((other, recording, policy)) == 2
        assert f"{other} holds {what}; give another --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changed, words",
    [
        ({"steps": 0}, "--steps are 1 or more"),
        ({"batch": 0}, "--batch and --steps are 1 or more"),
        ({"learning_rate": -1.0}, "--learning-rate is above 0"),
    ],
)
def test_settings_with_which_nothing_is_learned_are_refused(library, changed, words, tmp_path):
    recording = library[1]
    with pytest.raises(TrainingError, match=words):
        train_imitation(recording, tmp_path, replace(QUICK, **changed), Imitation(), quiet)
    with pytest.raises(TrainingError, match="holds a recording; give another --out"):
        train_imitation(recording, recording, QUICK, Imitation(), quiet)


def test_a_person_types_a_goal_of_several_steps_on_the_page(library):
    assert learned(library) == 0
    world = GymnasiumWorld(Errands)
    agents = PageAgents(world, name=str(library[0])).agents()
    state = world.start(1, make_rng(3))
    goal = "go to the blue ball, then go to the red ball"
    make, words = agents.make, agents.words
    assert make is not None and words is not None
    agent = make(words(goal))
    assert agent.see is not None
    _, memory = agent.policy.act(agent.see(state), agent.policy.begin(1, make_rng(0)), make_rng(0))
    assert memory[0].goal == goal and [step.text for step in memory[0].plan.steps] == goal.split(", then ")
    with pytest.raises(PlanningError, match="no skill does 'ball ball'"):
        words("ball ball")


def test_an_actor_of_many_episodes_is_as_of_each_alone(library):
    assert learned(library) == 0
    world = GymnasiumWorld(Both)
    actor = terrella.load_policy(str(library[0]), world.spec)
    assert isinstance(actor, SkillActor)
    seen = [world.render(world.start(1, make_rng(n)), actor.sees) for n in (1, 2)]
    together = {name: torch.cat([one[name] for one in seen]) for name in actor.sees}
    many, _ = actor.act(together, actor.begin(2, make_rng(0)), make_rng(0))
    alone = [actor.act(one, actor.begin(1, make_rng(0)), make_rng(0))[0] for one in seen]
    assert many.tolist() == torch.cat(alone).tolist()
