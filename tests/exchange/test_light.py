"""Who only converts needs neither torch nor packages of formats that are not used."""

from __future__ import annotations

import subprocess
import sys

ABSENT = ("torch", "mcap", "foxglove", "google.protobuf", "h5py", "rerun", "minari", "vizdoom", "onnxruntime")
SCRIPT = f"""
import sys
for name in {ABSENT!r}:
    sys.modules[name] = None
from pathlib import Path
import numpy as np
from terrella.data import Readings, Sensor, Source, Take
from terrella.exchange import open_source, write_source
import terrella.exchange.browse, terrella.exchange.live
time_s = np.arange(4) / 10
sensor = Sensor("observation.state", "vector", (2,))
source = Source("s", {{sensor.name: sensor}}, lambda: [Take({{sensor.name: Readings(time_s, np.ones((4, 2), "f4"))}})], 10.0)
root = Path(sys.argv[1])
assert write_source(source, root / "rows") == []
assert open_source(root / "rows").sensors[sensor.name].shape == (2,)
for to, package in (("mcap", "mcap"), ("robomimic", "hdf5")):
    try:
        write_source(source, root / to, to)
    except Exception as error:
        assert f"terrella[{{package}}]" in str(error), error
    else:
        raise AssertionError(to)
"""


def test_a_recording_is_converted_without_torch_and_without_what_it_does_not_need(tmp_path):
    ran = subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path)], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
