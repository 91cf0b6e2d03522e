"""Laws of a story: keys become actions, the past can be returned to, memory stays flat, recordings are whole."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import Spec, State, check_world, make_rng
from terrella.core.errors import DatasetError, ServeError
from terrella.serve.actions import action_of_keys
from terrella.serve.history import History, Moment
from terrella.serve.protocol import DONE, FRESH
from terrella.serve.story import Story, StoryConfig

from .conftest import ListSink
from .panorama import BUTTONS, PIXELS_PER_STEP, Panorama, SlowDream

LEFT, RIGHT, WALK = ("ArrowLeft",), ("ArrowRight",), ("KeyW",)


def spec_of(space, keys):
    return Spec(name="w", action=space, channels={}, observes=(), dt_s=1.0, keys=keys)


@pytest.mark.parametrize("forkable", [True, False])
def test_the_fake_keeps_the_contract(forkable):
    check_world(Panorama(forkable=forkable))


def test_buttons_held_together_are_all_pressed():
    spec = Panorama().spec
    held = action_of_keys(spec, ("KeyW", "ArrowUp", "ArrowLeft", "F13"))
    assert held.tolist() == [[1, 0, 0, 0, 1, 0]] and len(BUTTONS) == 6
    spec.check_action(held, 1)


def test_axes_keep_their_negative_side():
    box = spec_of(spaces.Box(-1, 1, (2,), np.float32), {"KeyW": [1.0, 0.0], "KeyA": [0.0, -1.0], "KeyD": [0.0, 1.0]})
    assert action_of_keys(box, ("KeyW", "KeyA")).tolist() == [[1.0, -1.0]]
    assert (
        action_of_keys(box, ("KeyA", "KeyD")).tolist() == action_of_keys(box, ("KeyD", "KeyA")).tolist() == [[0.0, 1.0]]
    )
    assert action_of_keys(box, ()).tolist() == [[0.0, 0.0]]


def test_of_choices_the_last_key_wins():
    choice = spec_of(spaces.Discrete(3, start=1), {"KeyA": [2.0], "KeyD": [3.0]})
    assert action_of_keys(choice, ("KeyD", "KeyA")).tolist() == [2]
    assert action_of_keys(choice, ()).tolist() == [1]


def test_rewinding_and_branching_tells_the_same_story_again():
    story = Story([Panorama()], seed=3)
    plan = [LEFT] * 5 + [WALK] * 5 + [RIGHT] * 5
    first = [story.step(held).images for held in plan]
    story.stand_at(4)
    assert story.rewound and story.shown.images == first[3]
    story.branch()
    assert not story.rewound and story.newest_step == 4
    again = [story.step(held).images for held in plan[4:]]
    assert again == first[4:]
    assert again != first[3:-1], "the frames differ from step to step, or this proves nothing"


def test_another_branch_is_another_story():
    story = Story([Panorama()], seed=3)
    first = [story.step(LEFT).images for _ in range(6)]
    story.stand_at(2)
    story.branch()
    assert [story.step(RIGHT).images for _ in range(4)] != first[2:]


def test_going_back_to_now_loses_nothing():
    story, twin = Story([Panorama()], seed=1), Story([Panorama()], seed=1)
    for _ in range(8):
        story.step(LEFT), twin.step(LEFT)
    story.stand_at(2)
    story.to_newest()
    assert [story.step(WALK).images for _ in range(3)] == [twin.step(WALK).images for _ in range(3)]


def test_a_seed_is_a_story():
    story = Story([Panorama()], seed=1)
    first = story.shown.images
    story.step(LEFT)
    assert story.restart(2).images != first and story.restart(1).images == first


def test_a_restart_that_fails_leaves_the_old_story():
    world = Panorama()
    story = Story([world], seed=1)
    shown = story.step(WALK)

    def broken(batch, rng):
        raise DatasetError("the game is gone")

    world.start = broken
    with pytest.raises(DatasetError, match="gone"):
        story.restart(2)
    assert story.seed == 1 and story.shown is shown and story.step(WALK).step == shown.step + 1


def test_a_running_game_does_not_rewind():
    story = Story([Panorama(forkable=False)], seed=0)
    story.step(LEFT)
    with pytest.raises(ServeError, match="running game"):
        story.stand_at(0)
    assert story.oldest_step == story.newest_step == 1 and story.step(LEFT).step == 2


def test_done_begins_the_next_episode():
    story = Story([Panorama(length=3)], seed=0)
    flags = [story.step(WALK).flags for _ in range(5)]
    assert flags == [0, 0, DONE, FRESH, 0]
    assert story.shown.episode_return == 1.0


def test_memory_is_bounded():
    world = Panorama()
    story = Story([world], seed=0, config=StoryConfig(history_s=64 / 50))
    for _ in range(200):
        story.step(LEFT)
    assert len(story.pictures()) == 64 and story.newest_step - story.oldest_step == 63
    full = story.state_bytes
    for _ in range(100):
        story.step(LEFT)
    assert story.state_bytes == full > 0


def test_states_keep_to_their_budget_and_pictures_outlive_them():
    history = History(frames=10, state_bytes=4 * 800)
    for step in range(30):
        history.push(Moment(step, (b"x",), states=(State({"z": torch.zeros(1, 100, dtype=torch.float64)}),)))
    assert len(history) == 10 and history.oldest_step == 26 and history.state_bytes == 3200
    assert history.at(0).step == 26 and history.at(99).step == 29
    history.forget_after(27)
    assert history.newest.step == 27 and history.state_bytes == 1600


def test_shared_memory_counts_once():
    cache = torch.zeros(1, 1000)
    history = History(frames=10, state_bytes=2**20)
    for step in range(5):
        history.push(Moment(step, (b"x",), states=(State({"cache": cache, "n": torch.tensor([step])}),)))
    assert history.state_bytes == 4000 + 5 * 8
    history.forget_after(0)
    assert history.state_bytes == 4000 + 8


def test_turning_left_moves_the_picture_right():
    world, rng = Panorama(), make_rng(0)
    state = world.start(1, rng)
    before = world.render(state, ("rgb",))["rgb"][0].float()
    state = world.imagine(state, action_of_keys(world.spec, LEFT), rng)
    after = world.render(state, ("rgb",))["rgb"][0].float()
    assert torch.equal(after[6:, PIXELS_PER_STEP:], before[6:, :-PIXELS_PER_STEP])


def test_a_dream_begins_where_the_game_is():
    story = Story([Panorama(forkable=False), SlowDream()], seed=5)
    game, dream = story.shown.images
    assert game == dream and not story.notice
    for _ in range(4):
        story.step(LEFT)
    assert len(story.shown.images) == 2 and "running game" in story.no_rewind
    story.sync()
    assert story.step(LEFT).step == 6


def test_a_dream_that_cannot_look_starts_on_its_own():
    dream = SlowDream()
    object.__setattr__(dream.spec, "observes", ("sonar",))
    story = Story([Panorama(), dream], seed=5)
    assert "on its own" in story.notice and story.step(LEFT).step == 1


def test_a_dream_is_told_what_it_heeds():
    told = []

    class Heeding(SlowDream):
        def observe(self, observation, prior, rng):
            told.append(set(observation))
            return super().observe(observation, prior, rng)

    dream = Heeding()
    object.__setattr__(dream.spec, "may_observe", ("reward", "sonar"))
    Story([Panorama(), dream], seed=5)
    assert told == [{"pose", "reward"}], "and not of what the game does not show"


def test_a_recording_holds_each_observation_with_what_followed():
    sink = ListSink()
    story = Story([Panorama(length=5)], seed=0, sink_factory=lambda: sink)
    story.record(True)
    for _ in range(9):
        story.step(WALK)
    story.record(False)
    actions = [action is not None for _, action, _, _ in sink.rows]
    # recorded from step 1: steps 2..5 answer, then the terminal row; the next episode begins at step 6
    assert actions == [True] * 4 + [False] + [True] * 3 + [False] and sink.ends == 2 and sink.closed
    assert sink.rows[0][0]["rgb"].shape == (48, 64, 3) and sink.rows[0][0]["pose"].shape == (7,)
    assert sink.rows[3][3] is True and sink.rows[2][3] is False
    walked = [row[0]["pose"][0] for row in sink.rows[:5]]
    assert np.allclose(np.diff(walked), 0.1)


def test_branching_ends_the_recorded_episode():
    sink = ListSink()
    story = Story([Panorama()], seed=0, sink_factory=lambda: sink)
    story.record(True)
    for _ in range(6):
        story.step(WALK)
    story.stand_at(3)
    story.branch()
    assert sink.ends == 1
    story.step(LEFT), story.step(LEFT)
    story.close()
    assert sink.ends == 2 and sink.closed


def test_play_goes_on_where_the_recording_cannot():
    class FullDisk(ListSink):
        def add(self, *row):
            raise DatasetError("the disk is full; make room.")

    sink = FullDisk()
    story = Story([Panorama()], seed=0, sink_factory=lambda: sink)
    story.record(True)
    for _ in range(4):
        story.step(WALK)
    assert not story.recording and "disk is full" in story.notice and sink.closed and story.newest_step == 4


def test_worlds_without_a_picture_are_refused():
    blind = Panorama()
    object.__setattr__(blind.spec, "channels", {"pose": blind.spec.channels["pose"]})
    with pytest.raises(ServeError, match="no picture"):
        Story([blind], 0)
    other = SlowDream()
    object.__setattr__(other.spec, "action", spaces.Discrete(2))
    with pytest.raises(ServeError, match="different actions"):
        Story([Panorama(), other], 0)
