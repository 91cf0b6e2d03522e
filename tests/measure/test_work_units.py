"""Work in units: the time left is honest, what was done is kept, and damage or another exam starts afresh."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from panorama import SHORT, Panorama, exam_of, some_clips

from terrella.core.errors import TerrellaError
from terrella.measure import LONG, ExamConfig, examine
from terrella.measure.work_units import Store


class Clocked(Panorama):
    """Its verbs take time by a clock of their own: more for a batch, and twice as much when `slow` is asked."""

    now = 0.0
    price = 0.02

    def imagine(self, state, action, rng):
        Clocked.now += 0.01 + self.price * state.batch
        return super().imagine(state, action, rng)

    def observe(self, observation, prior, rng):
        Clocked.now += 0.005 + 0.3 * self.price * len(next(iter(observation.values())))
        return super().observe(observation, prior, rng)

    def render(self, state, channels):
        Clocked.now += 0.5 * self.price * state.batch * ("rgb" in channels)
        return super().render(state, channels)


@pytest.mark.parametrize("flaw", ("", "shy"))
def test_the_time_left_is_right_within_a_third_from_the_first_line_on(flaw, monkeypatch):
    config = ExamConfig(
        (1, 8, 32),
        (8,),
        **{**SHORT, "batch": 4, "closure_deg": (90.0,), "closure_clips": 4, "long_steps": 100, "speed_steps": 30},
    )
    exam = exam_of(
        {"a": Clocked(flaw)}, {"recorded": some_clips(12)}, config, sets={LONG: {"recorded": some_clips(5, 64)}}
    )
    told: list[tuple[float, float]] = []
    Clocked.now = 0.0
    examine(exam, progress=lambda share, words, left: told.append((Clocked.now, left)), clock=lambda: Clocked.now)
    told, whole = told[1:], Clocked.now  # the first is said while nothing is known yet
    assert len(told) > 100
    for now, left in told:
        true = whole - now
        if true > 0.05 * whole:
            assert left == pytest.approx(true, rel=0.3), f"{left:.1f} s left was said after {now:.1f} s of {whole:.1f}"


def test_a_machine_that_slows_down_is_noticed():
    exam = exam_of({"a": Clocked()}, {"recorded": some_clips(12)}, replace(exam_of({}).config, batch=2))
    told: list[tuple[float, float]] = []

    def tell(share, words, left):
        told.append((Clocked.now, left))
        Clocked.price = 0.06 if share > 0.3 else 0.02

    Clocked.now, Clocked.price = 0.0, 0.02
    examine(exam, progress=tell, clock=lambda: Clocked.now)
    whole, Clocked.price = Clocked.now, 0.02
    for now, left in told:
        if 0.6 * whole < now < 0.95 * whole:
            assert left == pytest.approx(whole - now, rel=0.3)


def test_shares_only_grow():
    shares: list[float] = []
    exam = exam_of({"a": Panorama()}, {"recorded": some_clips(4)})
    examine(exam, progress=lambda share, words, left: shares.append(share))
    assert shares == sorted(shares) and shares[-1] == 1


def test_what_was_kept_of_another_exam_does_not_count(tmp_path):
    seen: list[int] = []

    class Counted(Panorama):
        def imagine(self, state, action, rng):
            seen.append(1)
            return super().imagine(state, action, rng)

    def run(**more) -> int:
        seen.clear()
        examine(
            exam_of({"a": Counted()}, {"recorded": some_clips(4)}, seed=more.pop("seed", 0)), tmp_path / "parts", **more
        )
        return len(seen)

    first, again = run(), run()
    assert again < first / 4, "nothing but the prices is measured twice"
    assert run(identity="other weights") == first and run(seed=1) == first
    damaged = sorted((tmp_path / "parts").rglob("*.safetensors"))[0]
    damaged.write_bytes(b"damaged")
    assert again <= run(seed=1) < first


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrellaError, match="cannot write to"):
        Store(tmp_path / "file" / "inside", "x")
    store = Store(tmp_path / "parts", "x")
    store.put("a|0", {"values": torch.arange(3)})
    assert torch.equal(Store(tmp_path / "parts", "x").get("a|0")["values"], torch.arange(3))
    assert Store(tmp_path / "parts", "y").get("a|0") is None
