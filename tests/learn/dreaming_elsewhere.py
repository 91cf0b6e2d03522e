"""What a training looks at and learns its uncertainty from, on the pretended device of another_device.py: strips, rollouts, drift;
and what a latent world is validated by.

Run as a program with a recording and the folder of a world with an uncertainty. `test_devices.py` does.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from another_device import OTHER, Pretended
from torch.overrides import TorchFunctionMode

from terrella.data import ClipCache, Dataset
from terrella.learn import latent_validation, strips
from terrella.learn.objectives.drift import drift_frames
from terrella.learn.objectives.uncertainty import DreamSettings, dream
from terrella.learn.recipes.latent import LatentTraining, train_latent
from terrella.learn.recording import Recording
from terrella.space.floorplan import floor_plan
from terrella.worlds.folder import load_latent, load_world


class Made(TorchFunctionMode):
    """What torch.tensor and new_tensor make for the device, which no dispatch sees."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        given = dict(kwargs or {})
        if function is torch.Tensor.new_tensor and args[0].device.type == OTHER.type:
            return torch.tensor(args[1], dtype=given.get("dtype", args[0].dtype)).to(OTHER)
        if function is not torch.tensor or torch.device(given.get("device") or "cpu").type != OTHER.type:
            return function(*args, **given)
        return function(*args, **{**given, "device": "cpu"}).to(given["device"])


def without_inference(function: Any) -> Any:
    """The pretended tensors cannot be inferred with."""
    return torch.no_grad()(function.__wrapped__)


def _validate(data: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        tiny = LatentTraining(steps=2, latent=8, hidden=16, members=2, history=1, rollout=2, leap=0, device="cpu")
        train_latent(data, folder, tiny, lambda *_: None)
        world = load_latent(Path(folder) / "world")
    for name in ("encode_rows", "open_loop", "rollout_frames"):
        setattr(latent_validation, name, without_inference(getattr(latent_validation, name)))
    with Made(), Pretended():
        there = world.to(OTHER)
        recording = Recording.open(Dataset(data), world.network.config.size, lambda *_: None)
        latent_validation.calibrate(there, recording)
        assert there.network.spread.device == OTHER
        assert latent_validation.validate(there, recording)["verdict"]
        assert latent_validation.rollout_frames(there, recording)


def main() -> None:
    data, run = map(Path, sys.argv[1:])
    world = load_world(run / "world")
    cache = ClipCache.open(Dataset(data), world.size)
    recording = Recording.of(cache, list(range(len(cache.episodes))), None)
    strips._dream = without_inference(strips._dream)
    with Made(), Pretended():
        there = world.to(OTHER)
        assert there.device == OTHER
        dreamt = without_inference(dream)(there, recording, DreamSettings(0, 2, 2, shown=(1,)), 0)
        drifted = without_inference(drift_frames)(there, recording, 3, 2)
        assert {part.device.type for part in (*dreamt, *drifted)} == {"cpu"} and torch.isfinite(drifted.error).all()
        strips.draw_strip([there], recording, run / "there.png")
        assert floor_plan(torch.zeros(0, 2, 4).to(OTHER), torch.zeros(0, 7).to(OTHER)).device == OTHER
    _validate(data)
    print("dreams elsewhere")


if __name__ == "__main__":
    main()
