"""The benchmark for GPUs is rehearsed on a CPU, so that whoever has a card need not mend it first."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "gpu.py"


def rehearsed(folder: Path, *only: str) -> list[dict]:
    out = folder / "bench.json"
    command = [sys.executable, str(SCRIPT), "--cpu", "--seconds", "0.1", "--out", str(out), "--only", *only]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(out.read_text())
    assert report["rehearsal"] and "a rehearsal" in done.stdout
    return report["rows"]


def test_it_is_rehearsed_without_a_card(tmp_path):
    rows = rehearsed(tmp_path, "arm", "flow training")
    assert [row["what"] for row in rows] == ["arm", "flow training"]
    assert all(row["per_s"] > 0 and not row["error"] and row["off"] == 0 for row in rows)
    assert rows[0]["kernels"] > 20 and rows[0]["profile"]["kernels"] and rows[0]["profile"]["call sites"]


@pytest.mark.slow
def test_all_of_it_is_rehearsed(tmp_path):
    rows = rehearsed(tmp_path, "doom-maze", "doom-corridor", "islet", "flow", "latent", "arm", "flow training")
    assert all(row["per_s"] > 0 and not row["error"] and row["off"] < 2e-3 for row in rows)
