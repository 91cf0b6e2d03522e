"""Laws of a timeline: what is held becomes actions, the past can be returned to, memory stays flat, recordings are whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.core import Spec, State, check_world, make_rng
from terrella.core.arena import Arena
from terrella.core.errors import DatasetError, ServeError
from terrella.serve.actions import action_of
from terrella.serve.history import History, Image, Moment
from terrella.serve.protocol import BEYOND, DONE, FRESH
from terrella.serve.timeline import Timeline

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
    held = action_of(spec, ("KeyW", "ArrowUp", "ArrowLeft", "F13"))
    assert held.tolist() == [[1, 0, 0, 0, 1, 0]] and len(BUTTONS) == 6
    spec.check_action(held, 1)


def test_axes_keep_their_negative_side():
    box = spec_of(spaces.Box(-1, 1, (2,), np.float32), {"KeyW": [1.0, 0.0], "KeyA": [0.0, -1.0], "KeyD": [0.0, 1.0]})
    assert action_of(box, ("KeyW", "KeyA")).tolist() == [[1.0, -1.0]]
    assert action_of(box, ("KeyA", "KeyD")).tolist() == action_of(box, ("KeyD", "KeyA")).tolist() == [[0.0, 1.0]]
    assert action_of(box, ()).tolist() == [[0.0, 0.0]]


def test_of_choices_the_last_key_wins():
    choice = spec_of(spaces.Discrete(3, start=1), {"KeyA": [2.0], "KeyD": [3.0]})
    assert action_of(choice, ("KeyD", "KeyA")).tolist() == [2]
    assert action_of(choice, ()).tolist() == [1]


def test_rewinding_and_branching_tells_the_same_story_again():
    timeline = Timeline([Panorama()], seed=3)
    plan = [LEFT] * 5 + [WALK] * 5 + [RIGHT] * 5
    first = [timeline.step(held).images for held in plan]
    timeline.stand_at(4)
    assert timeline.rewound and timeline.shown.images == first[3]
    timeline.branch()
    assert not timeline.rewound and timeline.history.newest.step == 4
    again = [timeline.step(held).images for held in plan[4:]]
    assert again == first[4:]
    assert again != first[3:-1], "the frames differ from step to step, or this proves nothing"


def test_another_branch_is_another_story():
    timeline = Timeline([Panorama()], seed=3)
    first = [timeline.step(LEFT).images for _ in range(6)]
    timeline.stand_at(2)
    timeline.branch()
    assert [timeline.step(RIGHT).images for _ in range(4)] != first[2:]


def test_going_back_to_now_loses_nothing():
    timeline, twin = Timeline([Panorama()], seed=1), Timeline([Panorama()], seed=1)
    for _ in range(8):
        timeline.step(LEFT), twin.step(LEFT)
    timeline.stand_at(2)
    timeline.to_newest()
    assert [timeline.step(WALK).images for _ in range(3)] == [twin.step(WALK).images for _ in range(3)]


def test_a_seed_is_a_story():
    timeline = Timeline([Panorama()], seed=1)
    first = timeline.shown.images
    timeline.step(LEFT)
    assert timeline.restart(2).images != first and timeline.restart(1).images == first


def test_a_restart_that_fails_leaves_the_old_story():
    world = Panorama()
    timeline = Timeline([world], seed=1)
    shown = timeline.step(WALK)

    def broken(batch, rng):
        raise DatasetError("the game is gone")

    world.start = broken
    with pytest.raises(DatasetError, match="gone"):
        timeline.restart(2)
    assert timeline.seed == 1 and timeline.shown is shown and timeline.step(WALK).step == shown.step + 1


def test_a_running_game_does_not_rewind():
    timeline = Timeline([Panorama(forkable=False)], seed=0)
    timeline.step(LEFT)
    with pytest.raises(ServeError, match="running game"):
        timeline.stand_at(0)
    assert timeline.history.oldest_step == timeline.history.newest.step == 1 and timeline.step(LEFT).step == 2


def test_done_begins_the_next_episode():
    timeline = Timeline([Panorama(length=3)], seed=0)
    flags, endings = zip(*[(timeline.step(WALK).flags, timeline.ending) for _ in range(5)])
    assert flags == (0, 0, DONE, FRESH, 0)
    assert timeline.shown.episode_return == 1.0
    assert [ending is not None for ending in endings] == [False, False, True, False, False]
    assert {"steps": 3, "score": 3.0, "vitals": ()}.items() <= endings[2].items(), "a page may miss its last picture"


def test_memory_is_bounded():
    world = Panorama()
    timeline = Timeline([world], seed=0, history_s=64 / 50)
    for _ in range(200):
        timeline.step(LEFT)
    assert len(timeline.pictures()) == 64 and timeline.history.newest.step - timeline.history.oldest_step == 63
    full = timeline.history.state_bytes
    for _ in range(100):
        timeline.step(LEFT)
    assert timeline.history.state_bytes == full > 0


def test_states_keep_to_their_budget_and_pictures_outlive_them():
    history = History(frames=10, state_bytes=4 * 800)
    for step in range(30):
        history.push(
            Moment(step, (Image(0, 0, b"x"),), states=(State({"z": torch.zeros(1, 100, dtype=torch.float64)}),))
        )
    assert len(history) == 10 and history.oldest_step == 26 and history.state_bytes == 3200
    assert history.at(0).step == 26 and history.at(99).step == 29
    history.forget_after(27)
    assert history.newest.step == 27 and history.state_bytes == 1600


def test_shared_memory_counts_once():
    cache = torch.zeros(1, 1000)
    history = History(frames=10, state_bytes=2**20)
    for step in range(5):
        history.push(Moment(step, (Image(0, 0, b"x"),), states=(State({"cache": cache, "n": torch.tensor([step])}),)))
    assert history.state_bytes == 4000 + 5 * 8
    history.forget_after(0)
    assert history.state_bytes == 4000 + 8


def test_rows_of_an_arena_count_once_and_bound_the_history():
    arena = Arena({"rgb": (torch.uint8, (1000,))})
    history, rows = History(frames=100, state_bytes=20_000), torch.zeros(1, 10, dtype=torch.int64)
    for step in range(50):  # each step replaces one of ten keyframes
        rows = rows.clone()
        rows[0, step % 10] = arena.keep({"rgb": torch.zeros(1, 1000, dtype=torch.uint8)})[0]
        history.push(Moment(step, (), states=(State({"rows": rows}, {"rows": arena}),)))
    kept = history.newest.step - history.oldest_step + 1
    assert 5 < kept < 15 and history.state_bytes == 1000 * (10 + kept - 1) + 80 * kept <= 20_000
    history.forget_after(history.oldest_step)
    assert history.state_bytes == 10 * 1000 + 80


def test_turning_left_moves_the_picture_right():
    world, rng = Panorama(), make_rng(0)
    state = world.start(1, rng)
    before = world.render(state, ("rgb",))["rgb"][0].float()
    state = world.imagine(state, action_of(world.spec, LEFT), rng)
    after = world.render(state, ("rgb",))["rgb"][0].float()
    assert torch.equal(after[6:, PIXELS_PER_STEP:], before[6:, :-PIXELS_PER_STEP])


def test_a_dream_begins_where_the_game_is():
    timeline = Timeline([Panorama(forkable=False), SlowDream()], seed=5)
    game, dream = timeline.shown.images
    assert game.jpeg == dream.jpeg and (game.world, dream.world) == (0, 1) and not timeline.notice
    for _ in range(4):
        timeline.step(LEFT)
    assert len(timeline.shown.images) == 2 and "running game" in timeline.no_rewind
    timeline.sync()
    assert timeline.step(LEFT).step == 6


def test_a_dream_that_cannot_look_starts_on_its_own():
    dream = SlowDream()
    object.__setattr__(dream.spec, "observes", ("sonar",))
    timeline = Timeline([Panorama(), dream], seed=5)
    assert "on its own" in timeline.notice and timeline.step(LEFT).step == 1


def test_a_dream_is_told_what_it_heeds():
    told = []

    class Heeding(SlowDream):
        def observe(self, observation, prior, rng):
            told.append(set(observation))
            return super().observe(observation, prior, rng)

    dream = Heeding()
    object.__setattr__(dream.spec, "may_observe", ("reward", "sonar"))
    Timeline([Panorama(), dream], seed=5)
    assert told == [{"pose", "reward"}], "and not of what the game does not show"


def test_trust_ends_where_the_card_says_it_was_measured_until_the_dream_observes_again():
    dream = SlowDream()
    dream.spec = replace(dream.spec, card={"trust_steps_measured": 2})
    both = Timeline([Panorama(), dream], 0)

    def beyond(moment: Moment) -> bool:
        return bool(moment.flags & BEYOND)

    assert [beyond(both.shown), *(beyond(both.step()) for _ in range(4))] == [False, False, False, True, True]
    assert not beyond(both.stand_at(2)) and not beyond(both.branch()), "in the past it was within"
    assert beyond(both.step())
    assert not beyond(both.sync()) and [beyond(both.step()) for _ in range(3)] == [False, False, True]
    assert not beyond(both.restart(1))
    assert not any(Timeline([Panorama()], 0).step().flags & BEYOND for _ in range(4)), "nobody measured it"


def test_a_recording_holds_each_observation_with_what_followed():
    sink = ListSink()
    timeline = Timeline([Panorama(length=5)], seed=0, sink_factory=lambda: sink)
    timeline.record(True)
    for _ in range(9):
        timeline.step(WALK)
    timeline.record(False)
    actions = [action is not None for _, action, _, _ in sink.rows]
    # recorded from step 1: steps 2..5 answer, then the terminal row; the next episode begins at step 6
    assert actions == [True] * 4 + [False] + [True] * 3 + [False] and sink.ends == 2 and sink.closed
    assert sink.rows[0][0]["rgb"].shape == (48, 64, 3) and sink.rows[0][0]["pose"].shape == (7,)
    assert sink.rows[3][3] is True and sink.rows[2][3] is False
    walked = [row[0]["pose"][0] for row in sink.rows[:5]]
    assert np.allclose(np.diff(walked), 0.1)


def test_branching_ends_the_recorded_episode():
    sink = ListSink()
    timeline = Timeline([Panorama()], seed=0, sink_factory=lambda: sink)
    timeline.record(True)
    for _ in range(6):
        timeline.step(WALK)
    timeline.stand_at(3)
    timeline.branch()
    assert sink.ends == 1
    timeline.step(LEFT), timeline.step(LEFT)
    timeline.close()
    assert sink.ends == 2 and sink.closed


def test_play_goes_on_where_the_recording_cannot():
    class FullDisk(ListSink):
        def add(self, observation, action, reward, done):
            raise DatasetError("the disk is full; make room.")

    sink = FullDisk()
    timeline = Timeline([Panorama()], seed=0, sink_factory=lambda: sink)
    timeline.record(True)
    for _ in range(4):
        timeline.step(WALK)
    assert (
        not timeline.recording.on
        and "disk is full" in timeline.notice
        and sink.closed
        and timeline.history.newest.step == 4
    )


def test_worlds_without_a_picture_are_refused():
    blind = Panorama()
    object.__setattr__(blind.spec, "channels", {"pose": blind.spec.channels["pose"]})
    with pytest.raises(ServeError, match="no picture"):
        Timeline([blind], 0)
    other = SlowDream()
    object.__setattr__(other.spec, "action", spaces.Discrete(2))
    with pytest.raises(ServeError, match="different actions"):
        Timeline([Panorama(), other], 0)
