"""Post-training (fewer steps, own dreams) on a small made-up place: laws, exact resume, honest failures."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tests.learn.small import BARE, DREAMS, STUDENT
from tests.learn.stopping import goes_on_exactly, quiet, resumes_exactly

from terrella.core import check_world, make_rng
from terrella.core.errors import DatasetError, TrainingError
from terrella.data import Recorder
from terrella.learn.objectives import distillation
from terrella.learn.objectives.distillation import Matching, draw_with_random_exit
from terrella.learn.objectives.dreams import DreamRollouts, dream_starts
from terrella.learn.paired import open_paired
from terrella.learn.recipes.post_training import distil, train_dreams
from terrella.learn.recipes.video import train_video
from terrella.learn.train_step import TrainStep
from terrella.worlds.checkpoint import data_file
from terrella.worlds.folder import load_world
from terrella.worlds.generator import generate
from terrella.worlds.uncertainty import UncertaintyProbe

from ..data.layouts import layout_of


@pytest.fixture(scope="module")
def places(bare_run):
    return load_world(bare_run[0] / "world")


@pytest.fixture(scope="module")
def moving(haunted_run):
    return load_world(haunted_run[0] / "world")


@pytest.fixture(scope="module")
def student(student_run):
    return load_world(student_run[0] / "world")


def now(seed: int, step: int = 0) -> TrainStep:
    return TrainStep(step, 0.0, torch.device("cpu"), np.random.default_rng(seed), make_rng(seed))


def tame(world):
    """The same world with a generator whose every weight counts a little (a fresh one only copies), and which no step of the
    flow blows up: on any processor, its gradients agree."""
    generator = copy.deepcopy(world.generator)
    with torch.no_grad():
        for weight in generator.parameters():
            weight.add_(0.02 * torch.randn(weight.shape, generator=make_rng(weight.numel())))
    return world.replaced(generator=generator)


@pytest.mark.exact
def test_distilling_gives_a_world_of_one_step_that_keeps_the_contract(student_run, student, teacher):
    out, facts = student_run
    assert facts["step"] == 3 and student.config.steps == 1
    assert "observes" in check_world(student)
    assert "4 to 1 steps" in str(student.spec.card["distilled"])
    changed = zip(student.generator.parameters(), teacher.generator.parameters())
    assert any(not torch.equal(a, b) for a, b in changed)
    assert list(out.glob("strip-*.png"))


@pytest.mark.slow
def test_a_stopped_distillation_goes_on_exactly(corridor, teacher, student_run, tmp_path):
    resumes_exactly(lambda out: distil(teacher, corridor, out, STUDENT, quiet), student_run[0], tmp_path, {"distil": 0})


@pytest.mark.exact
def test_a_stopped_training_on_dreams_goes_on_exactly(corridor, teacher, dreams_run, tmp_path):
    resumes_exactly(
        lambda out: train_dreams(teacher, corridor, out, DREAMS, quiet), dreams_run[0], tmp_path, {"dreams": 0}
    )


@pytest.mark.slow
def test_a_student_of_dreams_with_a_teacher_goes_on_exactly(corridor, teacher, student, tmp_path):
    def train(out):
        return train_dreams(student, corridor, out, DREAMS, quiet, teacher)

    goes_on_exactly(train, tmp_path / "a", tmp_path / "b", {"dreams": 0})


@pytest.mark.slow
def test_a_run_goes_on_only_from_the_world_and_the_settings_that_it_began_with(corridor, teacher, places, dreams_run):
    with pytest.raises(TrainingError, match="other settings"):
        train_dreams(teacher, corridor, dreams_run[0], replace(DREAMS, horizon=2), quiet)
    with pytest.raises(TrainingError, match="other settings"):
        train_dreams(places, corridor, dreams_run[0], DREAMS, quiet)


@pytest.mark.parametrize("kind, data, seed", [("places", "corridor", 0),
                                              pytest.param("places", "corridor", 1, marks=pytest.mark.slow),
                                              pytest.param("moving", "haunted", 0, marks=pytest.mark.slow)])  # fmt: skip
def test_training_shows_the_generator_what_play_shows_it(kind, data, seed, request):
    world = tame(request.getfixturevalue(kind))
    pair = open_paired(world, request.getfixturevalue(data), None, quiet)
    dreams, noted = DreamRollouts(world, pair.recording, 4, 2, now(seed)), []
    playing = dreams.world.replaced(
        uncertainty=UncertaintyProbe(lambda shown, clean, situation: noted.append((shown, clean)))
    )
    state = dreams.state
    for step in range(4):
        action = pair.recording.action(dreams.row)
        state = state.replace(actions=torch.cat([state["actions"][:, 1:], action[:, None]], 1))
        state = playing.observe({"pose": pair.recording.pose(dreams.row + 1)}, state, make_rng(step))
        rgb, batch = playing.render(state, ("rgb",))["rgb"], dreams.next_batch()
        shown, clean = noted.pop()
        for one, other in ((shown.glimpse.rgb, batch.shown.glimpse.rgb), (shown.last, batch.shown.last)):
            torch.testing.assert_close(one, other)
        torch.testing.assert_close(shown.context, batch.shown.context)
        dreams.go_on(clean)
        assert torch.equal(rgb, dreams.world.render(dreams.state, ("rgb",))["rgb"])
        truth = pair.recording.rgb(dreams.row).float() / 127.5 - 1
        assert torch.equal(batch.truth[:, :3], truth)


@pytest.mark.slow
def test_a_teacher_may_watch_the_dreams(corridor, teacher, student, places, tmp_path):
    train_dreams(student, corridor, tmp_path / "watched", DREAMS, quiet, teacher)
    train_dreams(student, corridor, tmp_path / "alone", DREAMS, quiet)
    watched, alone = (load_file(data_file(tmp_path / name / "world", "weights")) for name in ("watched", "alone"))
    assert any(not torch.equal(watched[name], alone[name]) for name in alone)
    with pytest.raises(TrainingError, match="other settings"):
        train_dreams(student, corridor, tmp_path / "alone", DREAMS, quiet, teacher)
    with pytest.raises(TrainingError, match="cannot teach"):
        train_dreams(student, corridor, tmp_path / "run", DREAMS, quiet, places)


@pytest.mark.slow
def test_a_world_in_which_things_move_learns_from_its_dreams(haunted, moving, tmp_path):
    assert moving.config.moving
    train_dreams(moving, haunted, tmp_path, DREAMS, quiet)
    assert "observes" in check_world(load_world(tmp_path / "world"))


@pytest.mark.slow
def test_a_many_step_world_of_moving_things_teaches_a_student_and_its_dreams(haunted, tmp_path):
    train_video(haunted, tmp_path / "teacher", replace(BARE, flow_steps=4), quiet)
    teacher = load_world(tmp_path / "teacher" / "world")
    assert teacher.config.moving and teacher.config.steps == 4
    distil(teacher, haunted, tmp_path / "student", STUDENT, quiet)
    student = load_world(tmp_path / "student" / "world")
    assert student.config.moving and student.config.steps == 1
    train_dreams(student, haunted, tmp_path / "dreams", DREAMS, quiet, teacher)
    assert "observes" in check_world(load_world(tmp_path / "dreams" / "world"))


def test_dreams_begin_where_the_episode_lasts(corridor, teacher):
    pair = open_paired(teacher, corridor, None, quiet)
    rows = dream_starts(pair.recording, 20)
    start = pair.recording.start
    assert len(rows) and all(start[row - 9] == start[row + 20] for row in rows)
    assert pair.recording.usable[np.concatenate([rows - 9, rows + 20])].all()
    with pytest.raises(DatasetError, match="shorter --horizon"):
        dream_starts(pair.recording, 200)


@pytest.mark.parametrize("half", [False, True])  # where bfloat16 is native, training uses it
def test_of_the_flow_steps_only_the_one_drawn_at_random_has_a_gradient(half, corridor, teacher, monkeypatch):
    def precision(device):
        return torch.autocast(device.type, torch.bfloat16, enabled=half)

    monkeypatch.setattr(distillation, "half_precision", precision)
    pair = open_paired(tame(teacher), corridor, None, quiet)
    generator = copy.deepcopy(pair.world.generator).requires_grad_(True)
    batch = pair.feed(2).batch(now(0))
    noise, exits = torch.randn(batch.truth.shape, generator=make_rng(1)), set()

    def clean_at(x, step):
        with precision(x.device):
            return generator(x, torch.full((2,), step / 4), batch.shown).float()

    for seed in range(12):
        exit_at = int(np.random.default_rng(seed).integers(4))
        exits.add(exit_at)
        x = noise
        with torch.no_grad():
            for step in range(exit_at):
                x = x + (clean_at(x, step) - x) / (4 - step)
        (alone,) = torch.autograd.grad(clean_at(x, exit_at).sum(), generator.enter.weight)
        clean = draw_with_random_exit(generator, noise, batch.shown, 4, np.random.default_rng(seed))
        (found,) = torch.autograd.grad(clean.sum(), generator.enter.weight)
        assert float((found - alone).norm()) < 1e-2 * float(alone.norm()), "relative: as near as rounding allows"
        if exit_at == 3 and not half:
            torch.testing.assert_close(clean, generate(generator, noise, batch.shown, 4), rtol=1e-3, atol=1e-3)
    assert exits == {0, 1, 2, 3}


def test_where_the_student_draws_as_the_teacher_nothing_pulls(corridor, teacher):
    pair = open_paired(tame(teacher), corridor, None, quiet)
    batch, matching = pair.feed(2).batch(now(0)), Matching(teacher.generator)
    clean = batch.truth.clone().requires_grad_()
    (still,) = torch.autograd.grad(matching.towards_teacher(clean, batch.shown, make_rng(2)), clean)
    assert not still.any()
    with torch.no_grad():
        for weight in matching.mimic.parameters():
            weight.mul_(1.05)
    (pull,) = torch.autograd.grad(matching.towards_teacher(clean, batch.shown, make_rng(2)), clean)
    assert pull.abs().sum() > 0


def test_a_world_of_one_step_teaches_nobody(corridor, places, tmp_path):
    with pytest.raises(TrainingError, match="--flow-steps 8"):
        distil(places, corridor, tmp_path, STUDENT, quiet)


@pytest.mark.exact
def test_flat_worlds_learn_no_dreams_and_teach_smaller_ones_alone(flat_run, corridor, tmp_path):
    flat = load_world(flat_run[0] / "world")
    with pytest.raises(TrainingError, match="for worlds that have"):
        train_dreams(flat, corridor, tmp_path, DREAMS, quiet)
    with pytest.raises(TrainingError, match="8 8 8 channels, and a student of 64 112 160 is no smaller"):
        distil(flat, corridor, tmp_path, STUDENT, quiet)


def test_what_does_not_fit_is_refused(teacher, corridor, tmp_path):
    with Recorder(tmp_path / "other", layout_of(10.0, ("left",), rgb=(24, 32))) as recorder:
        for _ in range(2):
            for step in range(60):
                picture = np.full((24, 32, 3), 40 + step, np.uint8)
                recorder.add({"rgb": picture}, np.array([step % 2]) if step < 59 else None, 0.5, False)
            recorder.end_episode()
    with pytest.raises(DatasetError, match="the actions left, which are not those of .*its own game"):
        train_dreams(teacher, tmp_path / "other", tmp_path / "run", DREAMS, quiet)
    with pytest.raises(TrainingError, match="1 or more"):
        train_dreams(teacher, corridor, tmp_path / "run", replace(DREAMS, horizon=0), quiet)
