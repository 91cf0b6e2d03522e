"""What flat worlds learn by is on one device, which is not the CPU: pretended, so that it is tried where there is no GPU."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_no_tensors_of_two_devices_meet():
    program = Path(__file__).parent / "another_device.py"
    ran = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert ran.stdout.splitlines() == [
        "mixing is refused",
        *["generator has a loss"] * 3,
        "scroll has a loss",
        "policy has a loss",
    ]
