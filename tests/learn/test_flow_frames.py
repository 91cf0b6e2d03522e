"""Flow of frames: its memory is what the recording's other frames show, and it learns what moves."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.data.layouts import layout_of
from tests.learn.small import BARE
from tests.learn.stopping import quiet, resumes_exactly

from terrella.core import check_world, make_rng
from terrella.core.errors import TrainingError
from terrella.data import Recorder
from terrella.learn.moves import Scrolling, stitch_episodes
from terrella.learn.objectives.flow_frames import (
    BLIND,
    DRAFTS,
    PAST,
    RECORDED,
    WHOLE,
    EarlierFrames,
    FlowClipMaker,
    FlowClips,
    FlowFrames,
)
from terrella.learn.recipes.student import student_settings, train_student
from terrella.learn.recipes.video import train_video
from terrella.learn.recipes.video_flat import comes_back
from terrella.learn.recording import Recording
from terrella.learn.subcloning import subclone
from terrella.learn.train_step import TrainStep
from terrella.space.recall import EMPTY, KEPT
from terrella.worlds.controls import Controls
from terrella.worlds.flow import FlowConfig, FlowNetwork
from terrella.worlds.folder import load_world

SIZE, FLAT = (24, 32), replace(BARE, geometry=False, steps=32)
MOVES = torch.tensor([[0, 0], [-2, 0], [2, 0]])


def step(share: float = 0.0, number: int = 0) -> TrainStep:
    return TrainStep(number, share, torch.device("cpu"), np.random.default_rng(number), make_rng(number))


@pytest.fixture(scope="module")
def scrolling(tmp_path_factory):
    """A recording of a wide picture, seen through a window that goes right and back: two pixels a step."""
    wide = np.random.default_rng(0).integers(0, 256, (SIZE[0] // 6, 20, 3), dtype=np.uint8).repeat(6, 0).repeat(6, 1)
    folder = tmp_path_factory.mktemp("scrolling") / "set"
    with Recorder(folder, layout_of(10.0, ("right",), rgb=SIZE)) as recorder:
        for _ in range(3):
            for row in range(81):  # edges at odd columns, which the estimate of the scroll looks at
                x = 1 + 2 * (row if row <= 40 else 80 - row)
                recorder.add({"rgb": wide[:, x : x + SIZE[1]]}, np.array([row < 40]) if row < 80 else None, 0.0, False)
            recorder.end_episode()
    return folder


@pytest.fixture(scope="module")
def recording(scrolling):
    return Recording.open(scrolling, SIZE, quiet)


def test_the_memory_of_a_row_is_its_own_picture(recording):
    stitched = stitch_episodes(recording, MOVES, torch.zeros(SIZE, dtype=torch.bool))
    rows = torch.tensor([0, 7, 40, 77])
    known = stitched.memory(rows, SIZE)
    off = (known[:, :3].float() - recording.rgb(rows.numpy()).float()).abs()
    assert (known[:, 3] > 0).all() and off.mean() < 4 and off.mean((1, 2, 3)).max() < 8, "but for the video's noise"
    unseen = recording.cache.episodes[recording.held_out[0]][0] if recording.held_out else None
    if unseen is not None:
        assert not stitched.memory(torch.tensor([unseen]), SIZE).any()


def test_some_clips_see_no_memory_some_all_and_some_what_the_last_frame_showed(recording):
    stitched = stitch_episodes(recording, MOVES, torch.zeros(SIZE, dtype=torch.bool))
    over = torch.zeros(SIZE, dtype=torch.bool)
    over[:2] = True
    rows = np.tile(np.arange(10, 17), (60, 1))
    clips = {"rgb": recording.rgb(rows.ravel()).unflatten(0, rows.shape).permute(0, 1, 3, 4, 2).numpy()}
    clips |= {"action": np.ones((60, 7, 1), np.float32), "row": rows}
    made = FlowClipMaker(Controls.buttons(1), 4, 60, stitched, over)(clips, step())
    assert made.memory is not None and made.memory.shape == (60, 3, 4, *SIZE)
    seen = (made.memory[:, 0, 3] > 0).float().mean((1, 2))
    shares = [(seen == 0).float().mean(), ((seen - 22 / 24).abs() < 1e-3).float().mean()]
    assert abs(shares[0] - BLIND) < 0.2 and abs(shares[1] - WHOLE) < 0.2 and sum(shares) < 1
    part = made.memory[(seen > 0) & (seen < 0.9), 0, 3]
    assert not part[..., -2:].any() and (part[:, 2:, :-2] > 0).all(), "the two columns that enter are new"


def test_frames_of_the_same_episode_before_the_clip_may_be_recalled():
    start = np.repeat([0, 40], [40, 300])
    past = EarlierFrames(
        torch.from_numpy(start), lambda rows: (rows % 256).to(torch.uint8)[:, None, None, None].expand(-1, 3, 8, 8)
    )
    draw = torch.linspace(0, 0.999, KEPT + 1).expand(4, -1).clone()
    draw[3, KEPT] = 0
    frames, keys = past.before(torch.tensor([0, 30, 250, 250]), draw)
    rows = frames[:, :, 0, 0, 0]
    assert (keys[[0, 3]] == EMPTY).all(), "nothing comes before an episode's first row, and some clips see nothing"
    assert rows[1].min() == 0 and rows[1].max() == 28 and rows[2].min() == 250 - PAST and rows[2].max() == 244
    torch.testing.assert_close(keys[1, :, 0], rows[1] / 255)


def test_pictures_come_back_where_they_change_as_a_whole(recording, tmp_path):
    """The recording scrolls by two pixels a step; in the other one a dot moves."""
    with Recorder(tmp_path / "set", layout_of(10.0, ("right",), rgb=SIZE)) as recorder:
        for row in range(90):
            picture = np.zeros((*SIZE, 3), np.uint8)
            picture[4:8, row % 28 : row % 28 + 4] = 255
            recorder.add({"rgb": picture}, np.array([True]) if row < 89 else None, 0.0, False)
        recorder.end_episode()
    assert comes_back(recording, 0) and not comes_back(Recording.open(tmp_path / "set", SIZE, quiet), 0)


def test_a_moving_paddle_does_not_scroll_the_picture(recording, tmp_path):
    """In a walled field a paddle and two balls move; the other recording scrolls."""
    with Recorder(tmp_path / "set", layout_of(10.0, ("right",), rgb=SIZE)) as recorder:
        for row in range(120):
            picture = np.full((*SIZE, 3), 40, np.uint8)
            picture[:2] = picture[:, :2] = picture[:, -2:] = 120
            picture[20:23, (x := 4 + 2 * abs(row % 18 - 9)) : x + 7] = (230, 160, 60)
            for ball in range(2):
                y, x = 4 + abs((row * (1 + ball)) % 24 - 12), 4 + abs((2 * row + 9 * ball) % 48 - 24)
                picture[y : y + 4, x : x + 4] = 255
            recorder.add({"rgb": picture}, np.array([row % 18 < 9]) if row < 119 else None, 0.0, False)
        recorder.end_episode()
    walled = Recording.open(tmp_path / "set", SIZE, quiet)
    assert [len(Scrolling.of(one, 0, 1 << 20).moves) for one in (walled, recording)] == [1, 3]


def test_a_room_that_one_turns_in_does_not_scroll():
    """Parts go on by 3, 7 and 12 pixels, in each fifth step all by 3: of the other steps that move explains a quarter."""
    wall = torch.randint(0, 256, (3, 48, 3000), dtype=torch.uint8, generator=make_rng(0))
    frames, at = [], [0, 0, 0]
    for row in range(200):
        parts = zip(wall.split((12, 24, 12), 1), at)
        frames.append(torch.cat([part[..., x : x + 64] for part, x in parts], 1))
        at = [x + step for x, step in zip(at, (3, 7, 12) if row % 5 else (3, 3, 3))]
    turned = SimpleNamespace(
        rows_within=lambda before, after: np.arange(1, len(frames)), rgb=lambda rows: torch.stack(frames)[rows]
    )
    assert len(Scrolling.of(turned, 0, 1 << 20).moves) == 1


def test_where_pictures_change_as_a_whole_a_critic_judges_what_is_sampled():
    torch.manual_seed(0)
    one, other = (
        FlowNetwork(FlowConfig((16, 16), 2, 36 + 2, channels=(16, 16, 16), recalls=each)) for each in (True, False)
    )
    objective = FlowFrames(one, 5e-3, 1, 4.0)
    assert "critic" in objective.modules and "critic" not in FlowFrames(other, 5e-3, 1, 4.0).modules
    frames = torch.randint(0, 256, (8, 3, 3, 16, 16), dtype=torch.uint8, generator=make_rng(0))
    kept = (
        frames[:, :KEPT].expand(-1, 3, -1, -1, -1)[:, :1].expand(-1, KEPT, -1, -1, -1),
        torch.full((8, KEPT, 192), EMPTY),
    )
    batch = FlowClips(frames, torch.zeros(8, 3, 1), None, *kept)
    named = {}
    for share in (0.0, 0.9):
        now = TrainStep(0, share, torch.device("cpu"), np.random.default_rng(0), make_rng(0))
        named[share] = [loss.learner for loss in objective.losses(batch, now)]
    assert named == {0.0: ["generator"], 0.9: ["generator", "critic"]}
    critic = objective.critic
    assert critic is not None
    drawn, last = torch.rand(4, 3, 16, 16), (torch.rand(4, 3, 16, 16), torch.rand(4, 3, 16, 16))
    pull = objective._pull(critic, drawn, last, torch.tensor([True, False, True, False]), now)
    assert pull[[0, 2]].abs().amax((1, 2, 3)).min() > 0 and not pull[[1, 3]].any(), "drafts stay means"


def learned(share: float) -> list[float]:
    """Losses of drafts of a dot that moves by two pixels, before and after 60 gradient steps."""
    torch.manual_seed(0)
    network = FlowNetwork(FlowConfig((16, 16), 2, 36 + 2, channels=(16, 16, 16)))
    objective, losses = FlowFrames(network, 5e-3, 1, 4.0), []
    frames = torch.zeros(8, 3, 3, 16, 16, dtype=torch.uint8)
    for row in range(3):
        for entry in range(8):
            frames[entry, row, :, 4 + entry, 2 + 2 * row : 5 + 2 * row] = 255
    optimiser = objective.learners["generator"].optimiser
    for number in range(60):
        for loss in objective.losses(FlowClips(frames, torch.zeros(8, 3, 1), None), step(share, number)):
            optimiser.zero_grad()
            loss.value.backward()
            optimiser.step()
            losses.append(float(loss.parts["draft"].detach()))
            assert set(loss.parts) == ({"draft"} if share < DRAFTS else {"draft", "drawn"})
    return losses


def test_a_still_picture_costs_nothing_before_training_whatever_the_noise_on_its_history():
    network = FlowNetwork(FlowConfig((16, 16), 2, 36 + 2, channels=(16, 16, 16)))
    still = torch.randint(0, 256, (8, 1, 3, 16, 16), dtype=torch.uint8, generator=make_rng(0)).expand(-1, 3, -1, -1, -1)
    (loss,) = FlowFrames(network, 5e-3, 1, 4.0).losses(FlowClips(still, torch.zeros(8, 3, 1), None), step())
    assert float(loss.value.detach()) == 0


@pytest.mark.parametrize(("share", "late"), [(0.0, False), (0.0, True), (0.9, True)])
def test_a_rollout_goes_on_with_what_is_drawn_in_half_of_the_clips(share, late, monkeypatch):
    """The network adds 20 of 255 to the last frame; the recorded frames are black."""
    network = FlowNetwork(FlowConfig((16, 16), 2, 36 + 2, channels=(16, 16, 16)))
    network.output.bias.data[:] = 20 / 127.5
    objective, seen = FlowFrames(network, 5e-3, 3, 4.0), []
    encode = objective._encode
    monkeypatch.setattr(objective, "_encode", lambda frames, *rest: (seen.append(frames), encode(frames, *rest))[1])
    clips = FlowClips(torch.zeros(8, 5, 3, 16, 16, dtype=torch.uint8), torch.zeros(8, 5, 1), None)
    list(objective.losses(clips, step(share, RECORDED if late else 0)))
    shown = [((frames[:, :, 0, 0, 0] + 1) * 127.5).round().int().tolist() for frames in seen]
    drawn = [[[0, 0], [20, 0], [40, 20]][at] for at in range(3)]
    assert shown == [[one if late else [0, 0]] * 4 + [[0, 0]] * 4 for one in drawn]


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_it_learns_what_moves(share):
    losses = learned(share)
    assert losses[-1] < 0.3 * losses[0]


@pytest.fixture(scope="module")
def flow_run(scrolling, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    return out, train_video(scrolling, out, FLAT, quiet)


def test_a_world_of_a_scrolling_recording_knows_its_ground(flow_run):
    out, facts = flow_run
    world = load_world(out / "world")
    assert facts["step"] == 32 and world.generator.kind == "flow"
    assert [-2, 0] in world.generator.moves.tolist() and [2, 0] in world.generator.moves.tolist()
    ground = world.scene.ground  # pyright: ignore[reportAttributeAccessIssue]
    assert (ground[3] > 0).float().mean() > 0.9 and ground.shape[2] >= 110
    assert "batches" in check_world(world)


@pytest.mark.exact
def test_a_stopped_run_goes_on_exactly(flow_run, scrolling, tmp_path):
    resumes_exactly(lambda out: train_video(scrolling, out, FLAT, quiet), flow_run[0], tmp_path, {"flow": 1})


@pytest.mark.parametrize(
    ("given", "why"),
    [({"frames": 1}, "--frames 1"), ({"channels": (8, 8)}, "three, each"), ({"channels": (8, 8, 12)}, "of 8")],
)
def test_what_no_flow_network_can_be_made_of_is_refused(scrolling, tmp_path, given, why):
    with pytest.raises(TrainingError, match=why):
        train_video(scrolling, tmp_path, replace(FLAT, **given), quiet)


def losses_of(teaching: float, taught: bool) -> dict[str, float]:
    """Of a network beside another of the same weights, or none."""
    torch.manual_seed(0)
    network = FlowNetwork(FlowConfig((16, 16), 2, 36 + 2, channels=(16, 16, 16)))
    torch.nn.init.normal_(network.output.weight, std=0.1)
    objective = FlowFrames(network, 5e-3, 1, 4.0, copy.deepcopy(network).eval() if taught else None, teaching)
    frames = torch.randint(0, 256, (4, 3, 3, 16, 16), dtype=torch.uint8, generator=make_rng(0))
    (loss,) = objective.losses(FlowClips(frames, torch.zeros(4, 3, 1), None), step(0.9))
    return {name: float(part.detach()) for name, part in loss.parts.items()}


def test_a_teacher_is_as_much_of_the_target_as_is_said():
    assert max(losses_of(1.0, True).values()) < 1e-6, "the student draws as the teacher"
    alone, half = losses_of(0.0, False), losses_of(0.5, True)
    assert losses_of(0.0, True) == alone
    assert all(0.2 * alone[name] < half[name] < 0.6 * alone[name] for name in alone)


def test_a_student_begins_with_channels_of_its_teacher():
    wide, narrow = (
        FlowConfig((16, 16), 2, 36 + 2, 2, channels=widths, normed=True) for widths in ((32, 24, 16), (16, 16, 8))
    )
    torch.manual_seed(0)
    teacher, same, student = FlowNetwork(wide), FlowNetwork(wide), FlowNetwork(narrow)
    torch.nn.init.normal_(teacher.output.weight, std=0.1)
    own = [name for name, _ in teacher.named_parameters() if not name.startswith("scrolling")]
    weights, whole = dict(teacher.named_parameters()), dict(subclone(teacher, same).named_parameters())
    assert all(torch.equal(whole[name], weights[name]) for name in own), "of as many channels all"
    part = dict(subclone(teacher, student).named_parameters())
    for name, gain in (("before.0.first.weight", 2**0.5), ("enter.weight", 1.0)):  # of 32 channels 16: they weigh more
        kept = part[name].flatten()[:200] / gain
        assert torch.isclose(weights[name].flatten()[:, None], kept).any(0).all(), name
    assert torch.equal(part["output.weight"], weights["output.weight"])


@pytest.mark.exact
def test_a_student_is_a_smaller_world_of_the_same_game(scrolling, tmp_path):
    train_video(scrolling, tmp_path / "teacher", replace(FLAT, channels=(16, 8, 8), steps=8), quiet)
    teacher = load_world(tmp_path / "teacher" / "world")
    settings = replace(student_settings(teacher), channels=(8, 8, 8), steps=16, batch=2)
    train = lambda out: train_student(teacher, scrolling, out, settings, quiet)  # noqa: E731
    facts = train(tmp_path / "student")
    student = load_world(facts["world"])
    assert student.generator.config.channels == (8, 8, 8) and student.spec.action_names == teacher.spec.action_names
    assert facts["gflop_per_frame"]["student"] < facts["gflop_per_frame"]["teacher"] and facts["step"] == 16
    ours, theirs = (one.generator.scrolling.state_dict() for one in (student, teacher))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs), "it scrolls as the teacher does"
    assert "batches" in check_world(student)
    resumes_exactly(train, tmp_path / "student", tmp_path / "cut", {"flow": 0})


@pytest.mark.exact
def test_its_drawing_steps_can_be_chosen(scrolling, tmp_path):
    train_video(scrolling, tmp_path, replace(FLAT, flow_steps=2, steps=3), quiet)
    assert load_world(tmp_path / "world").generator.config.steps == 2
