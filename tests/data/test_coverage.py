"""Coverage: a recording that teaches something is told from one in which nothing happens, or no action shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from gymnasium import spaces

from terrella.core import Spec
from terrella.data import Dataset, Layout, Recorder, measure_coverage


def recorded(root, follows: str):
    """600 frames of a square: it goes as the action says, by itself, or not at all; all over the picture."""
    names = ("left", "right", "up", "no")
    shown = {"rgb": spaces.Box(0, 255, (32, 32, 3), np.uint8)}
    layout = replace(Layout.of(Spec("toy", spaces.Discrete(4), shown, (), 0.1, action_names=names)), pictures="png")
    rng, at, choice = np.random.default_rng(0), np.zeros(2, int), 0
    with Recorder(root, layout) as recorder:
        for step in range(600):
            choice = int(rng.integers(4)) if step % 5 == 0 else choice
            picture = np.zeros((32, 32, 3), np.uint8)
            picture[at[0] : at[0] + 4, at[1] : at[1] + 4] = 200
            recorder.add({"rgb": picture}, np.array([choice], np.float32))
            led = ((0, -1), (0, 1), (1, 0), (0, 0))[choice]
            move = {"actions": led, "itself": rng.integers(-1, 2, 2), "nothing": 0}[follows]
            at = (at + move) % 28
    return measure_coverage(Dataset(root))


def test_it_tells_what_is_taught_from_what_is_not(tmp_path):
    led, alone, still = (recorded(tmp_path / name, name) for name in ("actions", "itself", "nothing"))
    assert led.shown["left"] and led.shown["right"] and led.shown["up"] and led.changed > 0.3 and not led.warnings()
    assert not any(alone.shown.values()) and "no action's effect stands out from chance in the" in alone.warnings()[0]
    assert still.changed == 0 and still.places == 1 and "0% of the frames" in still.warnings()[0]
    assert led.facts()["actions_with_a_clear_effect"].startswith(("3 of 4", "4 of 4"))
