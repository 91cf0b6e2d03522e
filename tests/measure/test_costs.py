"""Joules are those of the processors alone, also where their counters begin again; memory is that of one rollout."""

from __future__ import annotations

import math

import pytest
import torch
from gymnasium import spaces

from terrella.core import Spec, State, make_rng
from terrella.core.arena import Arena
from terrella.core.errors import TerrellaError
from terrella.core.policy import Idle
from terrella.measure import costs
from terrella.workflows import costs as workflow
from terrella.workflows.costs import CostsConfig, costs_of, measure_costs


def test_joules_of_counters_that_begin_again_and_of_no_machine_as_a_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(costs, "POWERCAP", tmp_path)
    for at, name in enumerate(("package-0", "package-1", "psys")):
        folder = tmp_path / f"intel-rapl:{at}"
        folder.mkdir()
        for file, text in (("name", name), ("energy_uj", "9000000"), ("max_energy_range_uj", "9999999")):
            (folder / file).write_text(f"{text}\n")
    meter = costs.EnergyMeter()
    assert meter.how.startswith("RAPL") and meter.joules() == 0
    (tmp_path / "intel-rapl:0" / "energy_uj").write_text("2000000")  # over its end
    (tmp_path / "intel-rapl:1" / "energy_uj").write_text("9500000")
    (tmp_path / "intel-rapl:2" / "energy_uj").write_text("9900000")
    assert meter.joules() == 3.5
    (tmp_path / "intel-rapl:0" / "name").unlink()
    (tmp_path / "intel-rapl:1" / "name").unlink()
    assert costs.EnergyMeter().how.startswith("estimated")


def test_without_the_right_to_read_the_counters_joules_are_estimated_and_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr(costs, "POWERCAP", tmp_path)
    (tmp_path / "intel-rapl:0" / "energy_uj").mkdir(parents=True)  # cannot be read, even by root
    meter = costs.EnergyMeter()
    assert meter.estimated and "root alone" in meter.how
    before, until = meter.joules(), costs.time.process_time() + 0.02
    while costs.time.process_time() < until:
        pass
    assert meter.joules() - before == pytest.approx(0.02 * costs.WATTS_OF_A_CORE, rel=0.5)


def test_a_gpu_that_nobody_can_measure_is_named():
    assert costs.EnergyMeter(cuda=True).how.endswith(", without the GPU")


class Hoarder:
    """Keeps a row of 1,024 bytes for each of the last `keeps` steps, besides 4 rows of its own."""

    def __init__(self, keeps: int, forkable: bool = True):
        self.keeps, self.arena = keeps, Arena({"value": (torch.float32, (256,))})
        self.own = self.arena.keep({"value": torch.ones(4, 256)})
        self.spec = Spec(
            "hoarder", spaces.Discrete(2), {"seen": spaces.Box(-1, 1, (2,))}, (), dt_s=0.5, forkable=forkable
        )

    def start(self, batch, rng):
        none = torch.zeros(batch, self.keeps, dtype=torch.int64)
        return State({"rows": torch.cat([self.own.expand(batch, 4), none], 1)}, {"rows": self.arena})

    def imagine(self, state, action, rng):
        new = self.arena.keep({"value": torch.zeros(state.batch, 256)})
        return state.replace(rows=torch.cat([state["rows"][:, :4], state["rows"][:, 5:], new[:, None]], 1))

    def render(self, state, channels):
        return {"seen": torch.zeros(state.batch, 2)}


@pytest.mark.parametrize("keeps, flat", [(8, True), (400, False)])
def test_memory_that_grows_is_named_and_the_worlds_own_is_apart(monkeypatch, keeps, flat):
    monkeypatch.setattr(workflow, "SECONDS", 0.01)
    world = Hoarder(keeps)
    found = costs_of(world, "hoarder", CostsConfig(minutes=1, batch=3))
    assert found.steps == 120 and found.flat == flat and found.shared_bytes == 4 * 1024
    rows = min(keeps, 120 + costs.WARM)
    assert found.session_bytes == rows * 1024 + (4 + keeps) * 8
    assert found.added_bytes == pytest.approx(0 if flat else 120 * 1024)
    assert [one.batch for one in found.imagined] == [1, 3] and found.energy.startswith(("estimated", "RAPL"))
    assert ("flat" in found.summary()) == flat and found.to_json()["watts"] > 0


def test_an_episode_that_ends_begins_again():
    world = Hoarder(8)
    world.spec = Spec("brief", spaces.Discrete(2), {"done": spaces.Box(0, 1, (), bool)}, (), dt_s=0.5)
    world.render = lambda state, channels: {"done": torch.ones(state.batch, dtype=torch.bool)}
    began, state = [], world.start(1, make_rng(0))
    costs.timed_play(world, state, Idle(world.spec), make_rng(0), 20, lambda: began.append(1) or state)
    assert len(began) == 20 + costs.WARM


def test_settings_that_make_no_sense_get_a_sentence():
    for minutes in (0, math.inf):
        with pytest.raises(TerrellaError, match="--minutes is a number above 0"):
            measure_costs("doom-maze", CostsConfig(minutes=minutes))
    with pytest.raises(TerrellaError, match="doom-maze"):
        measure_costs("doom-maz")
