"""Skills: phrases are mined from instructions, goals are read, and the likeliest order is chosen; all without a trained network."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.act.actor_network import ActorConfig
from terrella.act.imitation_network import ImitationConfig, ImitationNetwork
from terrella.act.sentences import vocabulary_of
from terrella.act.skills.library import Skill, SkillLibrary
from terrella.act.skills.observed_goal import ObservedGoal
from terrella.act.skills.phrases import Phrase, goal_of, phrases_of
from terrella.act.skills.predictor import SkillOutlook, SkillPredictor
from terrella.act.skills.search import SkillSearch, undone
from terrella.core.errors import CheckpointError, PlanningError
from terrella.core.spec import Spec
from terrella.workflows.goals import is_observation

TEXTS = [
    f"{verb} {colour} {kind}"
    for verb in ("go to the", "pick up the")
    for colour in ("red", "blue")
    for kind in ("key", "box")
]
TEXTS += [f"put the {colour} box next to the {other} key" for colour in ("red", "blue") for other in ("red", "blue")]
START, FREE, CARRIES = 0, 1, 2  # what the one channel of these tests holds


@dataclass(frozen=True)
class Known(SkillLibrary):
    """Its predictions are a rule: nothing but going begins while something is carried, and blue things suit it half as often."""

    def outlook(self, seen, texts, memory=None, waypoints=None):
        suits = []
        for value, text in zip(seen["hand"][:, 0].tolist(), texts):
            carried = 0.01 if value == CARRIES and not text.startswith("go") else 1.0
            suits.append(carried * (0.5 if value == FREE and "blue" in text else 1.0))
        logits = torch.tensor(suits).log()
        return SkillOutlook(logits, logits * 0, logits * 0 + 1)


def library_of(kind: type[SkillLibrary] = Known) -> SkillLibrary:
    torch.manual_seed(0)
    actor = ActorConfig((("hand", (1,)),), "choice", (), (0.0,), (2.0,), hidden=8)
    network = ImitationNetwork(ImitationConfig(actor, vocabulary=vocabulary_of(TEXTS), history=1)).eval()
    skills = tuple(Skill(phrase.name, phrase, 98, 98, 4.0, 1, 9) for phrase in phrases_of(TEXTS))
    texts = (*TEXTS, "", "")
    hands = [CARRIES if text.startswith("pick") else FREE if text else START for text in texts]
    ends = {"hand": torch.tensor(hands)[:, None].float()}
    predictor = SkillPredictor(network)
    return kind(skills, network, predictor, ends, texts)


def planned(goal, hand=START):
    search = SkillSearch(library_of())
    return search.plan(search.instructions_of(goal), {"hand": torch.tensor([[float(hand)]])})


def test_phrases_have_places_where_words_stand_for_each_other():
    phrases = phrases_of([*TEXTS, "wait"])
    assert {phrase.name: len(texts) for phrase, texts in phrases.items()} == {
        "go to the _ _": 4,
        "pick up the _ _": 4,
        "put the _ box next to the _ key": 4,
        "wait": 1,
    }
    going = next(phrase for phrase in phrases if phrase.name.startswith("go"))
    assert str(going) == "go to the blue|red box|key"
    assert going.fillings("go to red key".split()) == ["go to the red key"] == going.fillings("go to a red key".split())
    assert going.fillings("go to the box".split()) == ["go to the blue box", "go to the red box"]
    many = Phrase((("put",), *[("red", "blue", "green")] * 4))
    with pytest.raises(PlanningError, match="'put' leaves 81 instructions open, and 64 are searched: say more"):
        many.fillings(["put"])
    assert not going.fillings("go to the red key now".split()) and not going.fillings("pick up the red key".split())


@pytest.mark.parametrize(
    "text, groups",
    [
        ("Go to A, then pick up B and drop it, and then wait.", (("go to a",), ("pick up b", "drop it"), ("wait",))),
        ("go to a after you pick up b and pick up c", (("pick up b", "pick up c"), ("go to a",))),
        ("a and b, then c after you d", (("a", "b"), ("d",), ("c",))),
        ("a, b and c; d", (("a",), ("b", "c"), ("d",))),
        ("After you have a and b, c and d", (("a", "b"), ("c", "d"))),
        ("a, after that b. Afterwards c", (("a",), ("b",), ("c",))),
        (" . ", ()),
    ],
)
def test_a_goal_is_groups_of_phrases_in_order(text, groups):
    assert goal_of(text) == groups


def test_what_a_phrase_leaves_out_is_named_before():
    said = "go to the red key, put the red box next to, then go to it and pick it up"
    assert SkillSearch(library_of()).instructions_of(said) == (
        (("go to the red key",),),
        (("put the red box next to the red key",),),
        (("go to the red box",), ("pick up the red box",)),
    )
    assert goal_of("grasp a and lift it, b and c", lambda phrase: phrase.startswith("grasp")) == (
        ("grasp a and lift it",),
        ("b", "c"),
    )


def test_what_was_left_out_for_want_of_an_effect_is_said():
    library = library_of()
    search = SkillSearch(
        replace(library, skills=library.skills[:1], card={"without_effect": ["pick up the blue|red key"]})
    )
    with pytest.raises(
        PlanningError, match="'pick up the red key', for its end looks like any other moment. There are: go"
    ):
        search.instructions_of("pick up the red key")
    with pytest.raises(PlanningError, match="'pick up the red box'. There are: go"):
        search.instructions_of("pick up the red box")


def test_the_likeliest_order_is_found():
    plan = planned("pick up the red key and put the red box next to the red key")
    assert [step.text.split()[0] for step in plan.steps] == ["put", "pick"]  # with full hands nothing is put
    assert plan.probability == pytest.approx(0.99**2) and "(99%)" in str(plan)
    plan = planned("pick up the red key, then go to the red box")
    assert [step.text for step in plan.steps] == ["pick up the red key", "go to the red box"]


def test_an_open_argument_is_chosen():
    assert planned("go to the red box, then go to the key").steps[1].text == "go to the red key"


def test_what_is_left_of_a_plan_is_planned_anew():
    search = SkillSearch(library_of())
    groups = search.instructions_of("go to the red box and pick up the red key, then go to the blue box")
    plan = search.plan(groups, {"hand": torch.zeros(1, 1)})
    assert undone(plan, 0, groups) == groups and len(undone(plan, 1, groups)[0]) == 1
    assert undone(plan, 2, groups) == groups[1:] and undone(plan, 3, groups) == ()


@pytest.mark.parametrize(
    "goal, said",
    [
        ("go to the crimson box", "do not know 'crimson' in"),
        (
            "pick up the red key, then pick up the blue key",
            "the best, pick up the red key .99%., then pick up the blue key .1%.",
        ),
        ("put the key", "no skill does 'put the key'. There are: go to the _ _; "),
        (",", "say what to do"),
    ],
)
def test_goals_that_cannot_be_planned_are_named_in_a_sentence(goal, said):
    with pytest.raises(PlanningError, match=said):
        planned(goal)


def goal_of_hand(library, hand, within=0.05):
    spec = Spec("made", spaces.Discrete(2), {"hand": spaces.Box(0, 2, (1,), np.float32)}, (), 0.1)
    return ObservedGoal.of(f"hand={hand}", {"hand": torch.tensor([[float(hand)]])}, spec, within, library)


def test_an_observation_is_reached_by_the_skills_that_end_there():
    library = library_of()
    search, seen = SkillSearch(library), {"hand": torch.tensor([[float(START)]])}
    carried = search.towards(goal_of_hand(library, CARRIES), seen)
    assert [[len(texts) for texts in group] for group in carried] == [[4]], "one skill is enough"
    assert search.plan(carried, seen).steps[0].text.startswith("pick up the")
    assert goal_of_hand(library, START).distance({"hand": torch.tensor([[0.0], [2.0]])}).tolist() == pytest.approx(
        [0, 1], abs=1e-3
    )
    with pytest.raises(
        PlanningError, match="no skill ends within 0.05 of hand=1.5: 'go .*' comes nearest, 0.25 away; .* 0.26"
    ):
        search.towards(goal_of_hand(library, 1.5), seen)


def test_a_skill_that_cannot_begin_yet_comes_after_another():
    """Nothing is put down nor picked up while something is carried, so another skill is first."""
    library = library_of()
    hands = library.ends["hand"].clone()
    hands[[text.startswith("put") for text in library.end_texts]] = 0.5
    library = replace(library, ends={"hand": hands})
    groups = SkillSearch(library).towards(goal_of_hand(library, 0.5), {"hand": torch.tensor([[float(CARRIES)]])})
    plan = SkillSearch(library).plan(groups, {"hand": torch.tensor([[float(CARRIES)]])})
    assert [step.text.split()[0] for step in plan.steps] == ["go", "put"] and plan.probability > 0.4


def test_a_goal_that_the_skills_do_not_see_is_named():
    spec = Spec("made", spaces.Discrete(2), {"eye": spaces.Box(0, 2, (1,), np.float32)}, (), 0.1)
    with pytest.raises(
        PlanningError, match="the skills do not see 'eye'; they see hand. Give a goal of these, or in words."
    ):
        ObservedGoal.of("eye=1", {"eye": torch.ones(1, 1)}, spec, 0.05, library_of())


def test_a_goal_that_leaves_all_open_is_refused_and_arrays_that_are_no_pictures_keep_their_range():
    library = library_of()
    spec = Spec("made", spaces.Discrete(2), {"hand": spaces.Box(0, 2, (1,), np.float32)}, (), 0.1)
    with pytest.raises(PlanningError, match="hand=_ leaves every number open; give one or more"):
        ObservedGoal.of("hand=_", {"hand": torch.full((1, 1), torch.nan)}, spec, 0.05, library)
    shares = {"share": torch.zeros(2, 32, 32, 3)}
    spec = Spec("made", spaces.Discrete(2), {"share": spaces.Box(0, 1, (32, 32, 3), np.float32)}, (), 0.1)
    library = replace(library, ends=shares, end_texts=("go to the red key", "go to the blue key"))
    goal = ObservedGoal.of("share=a.npy", {"share": torch.ones(1, 32, 32, 3)}, spec, 0.05, library)
    assert goal.distance(shares).tolist() == pytest.approx([1, 1])
    with pytest.raises(PlanningError, match="comes nearest, 1 away; give another goal.$"):
        goal.instructions(library)


@pytest.mark.parametrize("text", ["a.png", "0.5,_", "0.1,1e-3", "nan,0", "cells.npy", "cells.json", "hand=1", "-1"])
def test_what_is_no_sentence_is_an_observation(text):
    assert is_observation(text)


@pytest.mark.parametrize("text", ["", "?", "go to the red ball", "go to the ball = red", "reward"])
def test_all_else_is_a_sentence(text):
    assert not is_observation(text)


def test_codes_of_cells_differ_or_not():
    """They are no shades: a wall (2) is not nearly an empty cell (1)."""
    ends = {"image": torch.ones(2, 7, 7, 3, dtype=torch.uint8)}
    ends["image"][1, 3, 6, 0] = 2
    library = replace(library_of(), ends=ends, end_texts=("go to the red key", "go to the blue key"))
    spec = Spec("made", spaces.Discrete(2), {"image": spaces.Box(0, 255, (7, 7, 3), np.uint8)}, (), 0.1)
    cells = torch.full((1, 7, 7, 3), torch.nan)
    cells[0, 3, 6, 0] = 2
    goal = ObservedGoal.of("image=cells.json", {"image": cells}, spec, 0.05, library)
    assert goal.distance(ends).tolist() == pytest.approx([1, 0], abs=1e-5) and goal.instructions(library) == (
        "go to the blue key",
    )


def test_a_picture_as_a_goal_is_compared_in_the_size_of_the_ends():
    ends = {"rgb": torch.zeros(2, 16, 16, 3, dtype=torch.uint8)}
    ends["rgb"][1] = 204
    library = replace(library_of(), ends=ends, end_texts=("go to the red key", "go to the blue key"))
    spec = Spec("made", spaces.Discrete(2), {"rgb": spaces.Box(0, 255, (32, 32, 3), np.uint8)}, (), 0.1)
    goal = ObservedGoal.of("a.png", {"rgb": torch.full((1, 32, 32, 3), 255, dtype=torch.uint8)}, spec, 0.3, library)
    assert goal.instructions(library) == ("go to the blue key",)
    assert goal.distance({"rgb": torch.full((1, 32, 32, 3), 255)}).item() < 0.01


def test_a_name_stands_for_a_goal_of_others(tmp_path):
    library = library_of(SkillLibrary)
    library.write(tmp_path)
    library.added("Tidy up", "pick up the red key, then go to the blue box").write_names(tmp_path)
    read = SkillLibrary.load(tmp_path)
    groups = SkillSearch(read).instructions_of("tidy up, then go to the red box")
    whole = SkillSearch(library).instructions_of("pick up the red key, then go to the blue box, then go to the red box")
    assert groups == whole and len(groups) == 3
    twice = read.added("all", "tidy up, tidy up").renamed("Tidy up", "clear")
    assert twice.composed["all"].count("pick up") == 2 and "clear" in twice.composed
    assert library.named_as(tmp_path).composed == read.composed
    for name in ("Tidy up", "tidy up", " ", "go to the _ _", "go to the red key"):
        with pytest.raises(PlanningError, match="no free name"):
            read.added(name, "go to the red box")


def test_a_library_is_written_renamed_and_read(tmp_path):
    library = library_of(SkillLibrary)
    library.write(tmp_path)
    library.renamed("go to the _ _", "walk").tried("walk", 2, 0).write_names(tmp_path)
    read = SkillLibrary.load(tmp_path)
    assert read.named("walk").own_tries == 2 and read.named("walk").works == pytest.approx(2 * 99 / 100 / 4)
    assert library.named("go to the _ _").works == pytest.approx(99 / 100), "as recorded"
    seen, texts = {"hand": torch.zeros(2, 1)}, ["go to the red key", "pick up the blue box"]
    assert torch.allclose(read.outlook(seen, texts).begins, library.outlook(seen, texts).begins)
    learned_again = library.named_as(tmp_path)
    assert [skill.name for skill in learned_again.skills] == [skill.name for skill in read.skills]
    assert library.named_as(tmp_path / "none") is library
    assert read.end_texts == library.end_texts and read.skill_of("go to the red key").name == "walk"
    with pytest.raises(PlanningError, match="no skill 'wolk'; did you mean 'walk'"):
        read.named("wolk")
    with pytest.raises(PlanningError, match="no free name"):
        read.renamed("walk", "pick up the _ _")
    with pytest.raises(CheckpointError, match="holds no skills"):
        SkillLibrary.load(tmp_path / "fast")
