"""Clips on a device: what the host cuts, cut where the recording lies; and a training step that waits for nothing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from tests.learn.stopping import quiet
from tests.learn.test_flow_frames import MOVES, SIZE, recording, scrolling, step  # noqa: F401
from tests.learn.test_trainer import Settings

from terrella.core.dispatch import Dispatches
from terrella.learn import trainer as module
from terrella.learn.device_clips import DeviceClips, DeviceGrounds
from terrella.learn.moves import stitch_episodes
from terrella.learn.objectives.flow_frames import DRAFTS, FlowFrames
from terrella.learn.recipes.video_flat import FlowRecipe
from terrella.learn.trainer import Run, Trainer
from terrella.space.recall import EMPTY, KEPT, keys_of
from terrella.worlds.flow import FlowConfig, FlowNetwork

OVER, SLOTS, ROLLOUT = torch.zeros(SIZE, dtype=torch.bool), 4, 4


def clips_on(device: str, recording, moves=MOVES) -> DeviceClips:  # noqa: F811
    grounds = DeviceGrounds(stitch_episodes(recording, moves, OVER), OVER, torch.device(device))
    return DeviceClips(recording, SLOTS, ROLLOUT, torch.device(device), grounds).sized(40)


def test_clips_are_rows_of_the_recording_that_follow_each_other(recording):  # noqa: F811
    clips = clips_on("cpu", recording)
    batch, picks = clips.batch(step()), None
    assert batch.frames.shape == (40, SLOTS + ROLLOUT, 3, *SIZE) and batch.actions.shape[:2] == (40, SLOTS + ROLLOUT)
    whole = recording.rgb(np.arange(recording.cache.length))
    lone = 0
    for frames in batch.frames:
        picks = [int((whole.int() - frame.int()).abs().sum((1, 2, 3)).argmin()) for frame in frames]
        assert all(torch.equal(whole[pick], frame) for pick, frame in zip(picks, frames))
        lone += torch.equal(frames[0], frames[SLOTS - 1]) and torch.equal(frames[1], frames[SLOTS - 1])
    assert lone < 20, "some begin with one frame repeated"
    other = clips.batch(step(number=1))
    assert not torch.equal(other.frames, batch.frames) and torch.equal(clips.batch(step()).frames, batch.frames)


def test_frames_before_the_clips_may_be_recalled(recording):  # noqa: F811
    batch = DeviceClips(recording, SLOTS, ROLLOUT, torch.device("cpu"), recalls=True).sized(40).batch(step())
    assert batch.kept is not None and batch.kept_keys is not None and batch.kept.shape == (40, KEPT, 3, *SIZE)
    some = batch.kept_keys[:, 0, 0] < EMPTY
    assert 0.3 < some.float().mean() < 0.9
    torch.testing.assert_close(batch.kept_keys[some], keys_of(batch.kept[some] / 255))


def test_frames_recorded_meanwhile_are_recalled_on_a_device_too(recording, scrolling):  # noqa: F811
    recipe, cpu = object.__new__(FlowRecipe), torch.device("cpu")
    network = SimpleNamespace(moves=torch.zeros(1, 2), config=SimpleNamespace(recalls=True))
    recipe.meanwhile, recipe.over = scrolling, OVER
    recipe.held = cast(Any, "on the device")
    recipe.parts = cast(Any, SimpleNamespace(run=SimpleNamespace(device=cpu, report=quiet), recording=recording))
    recipe.objective = cast(Any, SimpleNamespace(losses_per_batch=ROLLOUT, generator=network))
    recipe.video = cast(Any, SimpleNamespace(slots=SLOTS, size=SIZE))
    feed, rows = recipe._further_feed(4, 3)
    assert rows == 3 * 81 and cast(Any, feed.batch(step())).kept.shape == (8, KEPT, 3, *SIZE)


def test_the_memory_is_that_of_the_host(recording):  # noqa: F811
    stitched = stitch_episodes(recording, MOVES, OVER)
    grounds = DeviceGrounds(stitched, OVER, torch.device("cpu"))
    rows = torch.tensor([[5, 6, 7], [40, 41, 42]])
    rows = torch.cat([rows, rows + recording.cache.episodes[recording.held_out[0]][0]]) if recording.held_out else rows
    known = stitched.memory(rows.flatten(), SIZE).unflatten(0, rows.shape)
    assert known.any() and torch.equal(grounds.memory(rows, torch.full((len(rows),), 0.5)), known), "all of it"
    assert not grounds.memory(rows, torch.zeros(len(rows))).any(), "nothing"
    some = grounds.memory(rows, torch.ones(len(rows)))
    assert 0 < int((some > 0).sum()) < int((known > 0).sum()), "what the picture before showed"


def test_a_training_step_on_a_device_waits_for_nothing_and_copies_nothing(recording, tmp_path, monkeypatch):  # noqa: F811
    """From the clips to the new weights, and what is logged."""
    lists, tensor_of = [], torch.tensor
    network = FlowNetwork(FlowConfig(SIZE, SLOTS, 36 + SLOTS, len(MOVES) - 1, (8, 8, 8)))
    objective = FlowFrames(network, 1e-3, ROLLOUT, 2.0)
    run = replace(Run.of(tmp_path, Settings(), quiet), device=torch.device("meta"))
    trainer = Trainer(run, "flow", clips_on("meta", recording), objective, 100)
    monkeypatch.setattr(torch, "tensor", lambda *given, **kinds: lists.append(given) or tensor_of(*given, **kinds))
    trainer._step(0)  # makes the optimiser's state, and constants
    monkeypatch.setattr(Trainer, "share", DRAFTS + 0.1)
    monkeypatch.setattr(module, "LOG_EVERY", 20)
    trainer._step(201)
    lists.clear()
    with Dispatches("meta") as count:
        parts = trainer._step(201)
    assert set(parts) == {"draft", "drawn"} and len(parts["draft"]) == ROLLOUT
    assert count.waits == 0 and count.crossings == 0 and not lists, count.by_site.most_common(9)


def test_a_recording_that_does_not_fit_stays_on_the_cpu_which_is_said(recording, monkeypatch):  # noqa: F811
    recipe, card = object.__new__(FlowRecipe), SimpleNamespace(device=torch.device("cuda"))
    recipe.parts = cast(Any, SimpleNamespace(run=card, recording=recording))
    network = SimpleNamespace(config=SimpleNamespace(recalls=False))
    recipe.objective = cast(Any, SimpleNamespace(losses_per_batch=1, generator=network))
    recipe.video = cast(Any, SimpleNamespace(slots=2))
    recipe.begin = recipe.stitched = None

    def full(*given):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("terrella.learn.recipes.video_flat.DeviceClips", full)
    held, fits = recipe._on_device(1e12)
    other, half = recipe._on_device(1.0)
    assert held is other is None and fits.endswith("GiB) does not fit into its memory: clips come from the CPU")
    assert half.endswith("takes more than half of its memory: clips come from the CPU")
