"""How far a state is from its last evidence: it grows with every imagined step, and an observed pose ends the way."""

from __future__ import annotations

import torch

from terrella.core import State
from terrella.space.camera import planar_pose
from terrella.worlds.uncertainty import GONE, drift


def standing(x: float, heading: float) -> State:
    one = torch.ones(1)
    gone = torch.tensor([[7.0, 2.0, 0.5, 0.0, 0.0]])
    return State({"pose": planar_pose(x * one, 0 * one, 0 * one, heading * one), "gone": gone})


def test_an_observed_pose_ends_the_way_since_evidence_and_an_imagined_one_adds_to_it():
    before, after = standing(1.0, 0.2), standing(1.3, -0.1)
    imagined, observed = (dict(zip(GONE, drift(before, after, led=led)[0].tolist())) for led in (False, True))
    assert imagined["steps"] == observed["steps"] == 8.0
    assert abs(imagined["metres"] - 2.3) < 1e-5 and abs(imagined["radians"] - 0.8) < 1e-5
    assert observed["metres"] == observed["radians"] == 0.0
