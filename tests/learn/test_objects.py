"""A cast learned from a toy: a red figure that walks to the left every second step, and lies blue once it was shot at."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.learn.stopping import goes_on_exactly, quiet

from terrella.core.errors import DatasetError
from terrella.learn.objectives.objects import learn_objects
from terrella.learn.trainer import Run
from terrella.space.billboards import PICTURE, paint_billboards
from terrella.space.camera import planar_pose
from terrella.worlds.objects import LOOK, NUMBER, PLACE, Billboards, BillboardsConfig

pytestmark = pytest.mark.slow  # a sweep: `make test-all` runs it

CAMERA, SIZE = (0.5, 0.8, 0.5, 0.5), (48, 64)
EPISODES, LENGTH, STEP_M = 30, 16, 0.1


def figure(colour) -> torch.Tensor:
    return torch.tensor([*colour, 1.0])[:, None, None].expand(4, *PICTURE)


def toy() -> SimpleNamespace:
    """A recording of it, as learn_objects reads one, and its pictures."""
    rng, rows = np.random.default_rng(0), EPISODES * LENGTH
    objects, action = np.zeros((rows, 2, 4), np.float32), (rng.random((rows, 2)) < 0.06).astype(np.float32)
    pictures, depths, marks = [], [], []
    for episode in range(EPISODES):
        place, shot = np.array([3.5 + rng.random(), rng.random() - 0.8, 0.0], np.float32), False
        for step in range(LENGTH):
            row = episode * LENGTH + step
            if step:
                shot = shot or action[row - 1, 0] > 0
                place = place + np.array([0, STEP_M * (step % 2 == 0 and not shot), 0], np.float32)
            objects[row, 0] = (1, *place)
            look = figure((0.1, 0.1, 0.9)) if shot else figure((0.9, 0.1, 0.1))
            box = torch.tensor([0.8, 0.8, 0.0, 0.4] if shot else [0.4, 0.4, 0.0, 1.6])
            behind = torch.full((1, 3, *SIZE), 0.3), torch.full((1, *SIZE), 9.0)
            cards = torch.from_numpy(objects[row, None, :1, 1:]), look[None, None], box[None, None]
            rgb, depth, seen = paint_billboards(*behind, cards, torch.ones(1, 1).bool(), pose(1), CAMERA)
            pictures.append((rgb[0].permute(1, 2, 0) * 255).byte().numpy())
            depths.append(depth[0].numpy())
            marks.append(seen[0].numpy())
    episodes = [(first, first + LENGTH) for first in range(0, rows, LENGTH)]
    arrays = {"observation.objects": objects, "observation.instances": np.stack(marks)}
    cache = SimpleNamespace(
        arrays=arrays, episodes=episodes, length=rows, depth=np.stack(depths), pose=pose(rows).numpy()
    )
    usable, rgb = np.ones(rows, bool), np.stack(pictures)
    told = {"action": lambda at: torch.from_numpy(action[at]), "pose": lambda at: pose(rows)[at]}
    return SimpleNamespace(cache=cache, usable=usable, rgb=rgb, **told)


def pose(count: int) -> torch.Tensor:
    one = torch.ones(count)
    return planar_pose(0 * one, 0 * one, one, 0 * one)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    torch.manual_seed(0)
    objects, recording = Billboards(BillboardsConfig(actions=2, history=3, looks=6, moves=4, rows=2, starts=2)), toy()
    starts = pose(2)
    starts[1, 1] = 1.0  # whichever episode began nearest
    run = Run(tmp_path_factory.mktemp("objects"), {}, quiet)
    facts = learn_objects(run, objects, recording, recording.rgb.__getitem__, starts, CAMERA, 500)  # pyright: ignore
    return objects, facts, recording


def test_it_finds_the_two_looks_and_the_one_move(learned):
    objects, facts, _ = learned
    shown = objects.pictures[: facts["objects_looks"]].float()
    red = shown[:, 0].mean((1, 2)) > shown[:, 2].mean((1, 2))
    tall = objects.boxes[: facts["objects_looks"], 3] > 1
    assert 2 <= facts["objects_looks"] <= 6 and red.any() and (~red).any() and torch.equal(red, tall)
    assert torch.allclose(objects.moves[1 : facts["objects_moves"] + 1], torch.tensor([0.0, STEP_M, 0.0]), atol=0.02)


def test_a_story_begins_with_what_waited(learned):
    objects, _, recording = learned
    assert objects.begun[..., NUMBER].tolist() == [[1, 0], [1, 0]]
    assert np.allclose(objects.begun[0, 0, PLACE].numpy(), recording.cache.arrays["observation.objects"][0, 0, 1:])


def test_who_is_shot_at_falls_and_who_is_not_walks_on(learned):
    objects, _, _ = learned
    tall = objects.boxes[:, 3] > 1
    card, acts = objects.begun[:1, 0].clone(), torch.zeros(1, 3, 2)
    assert tall[int(card[0, LOOK])]
    with torch.no_grad():
        calm = objects.next_logits(card, pose(1), acts)
        acts[0, -1, 0] = 1
        shot = objects.next_logits(card, pose(1), acts)
    assert not objects.follows[1 + int(card[0, LOOK])].all()
    falls = [float(told.look.softmax(1)[0, ~tall].sum()) for told in (calm, shot)]
    assert falls[0] < 0.1 < 0.7 < falls[1]
    assert float(calm.gone.sigmoid()) < 0.05 and float(calm.move.softmax(1)[0, 1:].sum()) > 0.15


def test_a_recording_that_shows_no_thing_whole_teaches_nothing(tmp_path):
    objects, recording = Billboards(BillboardsConfig(actions=2, history=3, looks=6, moves=4, rows=2, starts=2)), toy()
    recording.cache.arrays["observation.instances"] = np.zeros_like(recording.cache.arrays["observation.instances"])
    with pytest.raises(DatasetError, match="no thing whole and near: record more"):
        learn_objects(Run(tmp_path, {}, quiet), objects, recording, recording.rgb.__getitem__, pose(1), CAMERA, 5)  # pyright: ignore


def test_a_stopped_run_goes_on_exactly(tmp_path):
    def train(out):
        torch.manual_seed(0)
        objects, recording = (
            Billboards(BillboardsConfig(actions=2, history=3, looks=6, moves=4, rows=2, starts=2)),
            toy(),
        )
        learn_objects(Run(out, {}, quiet), objects, recording, recording.rgb.__getitem__, pose(1), CAMERA, 5)  # pyright: ignore
        torch.rand(3)

    goes_on_exactly(train, tmp_path / "a", tmp_path / "b", {"objects": 2})
