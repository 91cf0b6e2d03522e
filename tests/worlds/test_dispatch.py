"""What a step dispatches on a device, counted without one: kernels, waits and crossings, the same for any batch."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import terrella
from terrella.core import chance, make_rng
from terrella.core.backend import tensor_programs
from terrella.core.dispatch import Dispatches
from terrella.worlds.config import HistoryConfig
from terrella.worlds.controls import AXES, Controls
from terrella.worlds.flow import FlowConfig, FlowNetwork
from terrella.worlds.frame_history import FrameHistory, StartClips
from terrella.worlds.latent import LatentWorld
from terrella.worlds.latent_network import LatentConfig, LatentNetwork
from terrella.worlds.learned import About, LearnedWorld


def flow(moves: int, recalls: bool = False) -> LearnedWorld:
    """A world of frames alone, 64 x 64, whose pictures scroll by as many moves."""
    size, slots, actions = (64, 64), 4, 4
    network = FlowNetwork(FlowConfig(size, slots, 36 + slots * actions, moves, recalls=recalls))
    network.moves[:, 0] = torch.arange(moves + 1)
    settings = HistoryConfig(
        size, slots, actions, tuple(map(tuple, network.moves.tolist())) if moves else (), recalls=recalls
    )
    starts = StartClips.of(torch.zeros(2, slots, 3, *size, dtype=torch.uint8), actions)
    return LearnedWorld(
        About("flow", Controls.buttons(actions), 0.1), scene=FrameHistory(settings, starts), generator=network
    )


def latent(pictures: bool) -> LatentWorld:
    """A latent world of pictures, or an arm whose latent is its joints."""
    controls = Controls(AXES, (-1.0,) * 2, (1.0,) * 2)
    shape: dict[str, Any] = (
        {"size": (64, 64)} if pictures else {"vectors": (("joints", 4), ("speed", 4)), "identity": True, "latent": 8}
    )
    network = LatentNetwork(LatentConfig(2, **shape))
    return LatentWorld(About("latent", controls, 0.1), network, torch.zeros(2, network.config.latent))


WORLDS = {
    "doom-maze": (lambda: terrella.load("doom-maze"), 885),
    "doom-corridor": (lambda: terrella.load("doom-corridor"), 1207),
    "flow": (lambda: flow(0), 285),
    "flow that scrolls": (lambda: flow(15), 384),
    "flow that recalls": (lambda: flow(0, recalls=True), 320),
    "islet": (lambda: terrella.load("islet"), 492),
    "latent": (lambda: latent(True), 80),
    "arm": (lambda: latent(False), 60),
}


@pytest.mark.exact
@pytest.mark.parametrize("name", WORLDS)
def test_a_step_is_few_kernels_without_a_wait_whatever_the_batch(name, monkeypatch):
    make, most = WORLDS[name]
    lists, tensor_of = [], torch.tensor  # copies of lists to a device are not dispatched on meta
    monkeypatch.setattr(torch, "tensor", lambda *given, **kinds: lists.append(given) or tensor_of(*given, **kinds))
    world = make().to("meta")
    shown = [channel for channel in ("rgb", "reward", "done") if channel in world.spec.channels]
    counts = []
    for batch in (1, 64):
        rng = make_rng(0)
        action = world.spec.sample_action(batch, rng)
        state = world.start(batch, rng)
        for _ in range(2):
            state = world.imagine(state, action, rng)
            world.render(state, shown)
        for arena in state.arenas.values():
            arena.make_room(batch)  # so that it does not grow in the step that is counted
        lists.clear()
        with Dispatches("meta") as count:
            state = world.imagine(state, action, rng)
            world.render(state, shown)
        assert not lists
        counts.append(count)
    assert all(count.kernels <= most for count in counts), counts[0].by_site.most_common(20)
    assert abs(counts[0].kernels - counts[1].kernels) <= 6, "a batch of one may skip a copy"
    assert all(count.waits == 0 and count.crossings <= 2 for count in counts), "the action and the seeds alone cross"


def test_a_draw_is_few_kernels_also_where_pictures_scroll():
    """The noise and the network with its memory; the rest of the step predicts the scroll and keeps the mosaic."""
    world, rng = flow(15).to("meta"), make_rng(0)
    state = world.start(2, rng)
    state = world.imagine(state, world.spec.sample_action(2, rng), rng)
    conditioning, seeds = world.look(state, state), chance.seeds(2, rng, "meta")
    world._generated(conditioning, seeds)  # makes constants
    with Dispatches("meta") as count:
        world._generated(conditioning, seeds)
    assert conditioning.mosaic is not None and count.kernels <= 300, count.by_site.most_common(20)


@pytest.mark.parametrize("name", ["doom-maze", pytest.param("doom-corridor", marks=pytest.mark.slow)])
def test_a_device_draws_what_the_kernels_draw(name):
    world, shown = terrella.load(name), []
    for way in (nullcontext, tensor_programs):
        with way():
            rng = make_rng(4)
            state = world.start(2, rng)
            for step in range(3):
                state = world.imagine(state, world.spec.sample_action(2, make_rng(step)), rng)
            shown.append(world.render(state, ["rgb", "depth", "pose", "uncertainty"]))
    kernels, programs = shown
    torch.testing.assert_close(programs["pose"], kernels["pose"], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(programs["uncertainty"], kernels["uncertainty"], atol=1e-4, rtol=1e-2)
    off = (programs["rgb"].int() - kernels["rgb"].int()).abs().amax(-1)
    assert float((off > 2).float().mean()) < 2e-3, "a pixel on the edge of a surface may fall to its other side"
    assert float(torch.isclose(programs["depth"], kernels["depth"], rtol=1e-2).float().mean()) > 0.998


def test_waits_crossings_and_masks_are_counted():
    some = torch.arange(6.0)
    with Dispatches("cpu") as count:
        some[some > 2], some.nonzero(), float(some[0]), some[torch.tensor([1, 2])].view(2, 1)
    assert count.waits == 3 and count.crossings == 0
    with Dispatches("meta") as count:
        some.to("meta") + 1
    assert count.crossings == 1 and count.kernels == 2 and "2 kernels" in str(count)


class Collisions(TorchDispatchMode):
    """The largest part of the points of a scatter that fall into one cell: a GPU takes these one after the other."""

    most, scatters = 0.0, 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if "scatter_reduce" in str(function):
            self.scatters += 1
            for cells in args[2]:
                self.most = max(self.most, int(cells.bincount().max()) / max(len(cells), 2048))
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", ["doom-maze", "doom-corridor"])
def test_points_out_of_view_do_not_wait_for_one_cell(name):
    world, rng = terrella.load(name), make_rng(0)
    with tensor_programs():
        state, action = world.start(1, rng), world.spec.sample_action(1, rng)
        with Collisions() as seen:
            world.render(world.imagine(state, action, rng), ["rgb"])
    assert seen.scatters and seen.most < 0.02
