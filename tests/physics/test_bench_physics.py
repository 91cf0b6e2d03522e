"""`bench physics`: the baselines order as they must, a guard helps beyond the ranges of training, and bad input gets a sentence."""

from dataclasses import replace

import pytest
import torch

from terrella.core.errors import TerrellaError
from terrella.sim.bodies import BodiesConfig, BodiesWorld
from terrella.workflows import bench_physics as bench
from terrella.workflows.bench_physics import BenchPhysicsConfig, bench_physics


def errors(result, family: str, split: str):
    return {
        one.arm: one.at(result.horizons[-1]).value for one in result.arms if (one.family, one.split) == (family, split)
    }


def test_baselines_alone(tmp_path):
    config = BenchPhysicsConfig(families=("uniform", "bouncing"), rollouts=8, steps=16, out=tmp_path)
    result = bench_physics(None, config)
    for split in ("in", "out"):
        free = errors(result, "uniform", split)
        assert free["linear"] < 1e-6 < free["truth, noisy start"] < free["copy-last"]
        assert errors(result, "bouncing", split)["linear"] > errors(result, "bouncing", split)["truth, noisy start"]
    assert result.verdict() == ["Baselines alone: give a WORLD, or --train MINUTES."]
    assert "bouncing, beyond them" in (tmp_path / "physics.html").read_text()
    assert "linear" in result.summary()


def test_a_world_is_judged_with_and_without_its_guard(tmp_path, monkeypatch):
    class Heavy:
        """Bouncing with twice the gravity."""

        def __init__(self):
            self.world = BodiesWorld("bouncing", BodiesConfig(pictures=False))
            self.spec = replace(self.world.spec, card={"game": "physics:bouncing"})

        def start(self, batch, rng):
            return self.world.start(batch, rng)

        def observe(self, observation, prior, rng):
            return self.world.observe(observation, prior, rng)

        def imagine(self, state, action, rng):
            after = self.world.imagine(state, action, rng)
            return after.replace(velocity=after["velocity"] - torch.tensor([0.0, 0.245]).double())

        def render(self, state, channels):
            return self.world.render(state, channels)

    monkeypatch.setattr(bench, "load_named", lambda *_, **__: Heavy())
    result = bench_physics("heavy", BenchPhysicsConfig(rollouts=8, steps=16, out=tmp_path))
    out = errors(result, "bouncing", "out")
    assert out["guarded"] < 0.5 * out["world"]
    assert result.verdict()[0].endswith("in 1 of 1 families.")
    assert [one.guard for one in result.arms if one.arm == "guarded"][0].startswith("128 steps; broken: free fall")


def test_bad_input_gets_a_sentence(tmp_path):
    with pytest.raises(TerrellaError, match="no family rocket"):
        bench_physics(None, BenchPhysicsConfig(families=("rocket",), out=tmp_path))
    with pytest.raises(TerrellaError, match="leave one of them out"):
        bench_physics("islet", BenchPhysicsConfig(train=1.0, out=tmp_path))
    with pytest.raises(TerrellaError, match="--seed is 0 or more; got -1"):
        bench_physics(None, BenchPhysicsConfig(seed=-1, out=tmp_path))
    with pytest.raises(TerrellaError, match="above 0 minutes"):
        bench_physics(None, BenchPhysicsConfig(train=0.0, out=tmp_path))
