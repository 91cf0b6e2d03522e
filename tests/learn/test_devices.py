"""What flat worlds learn by is on one device, which is not the CPU: pretended, so that it is tried where there is no GPU."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


def output_of(program: str, *given: object) -> list[str]:
    path = Path(__file__).parent / program
    ran = subprocess.run([sys.executable, path, *map(str, given)], capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr[-2000:]
    return ran.stdout.splitlines()


@pytest.mark.slow
def test_no_tensors_of_two_devices_meet():
    assert output_of("another_device.py") == [
        "mixing is refused",
        *["generator has a loss"] * 3,
        "scroll has a loss",
        "policy has a loss",
    ]


@pytest.mark.slow
def test_strips_and_the_rollouts_of_an_uncertainty_are_drawn_where_training_computes(corridor, flat_run):
    """On the CPU of a machine with a GPU they took half of the time of a training."""
    assert output_of("dreaming_elsewhere.py", corridor, flat_run[0]) == ["dreams elsewhere"]
