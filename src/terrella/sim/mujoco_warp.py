"""Steps batches of physics states on a GPU with `mujoco-warp` instead of `mujoco.rollout`; see mujoco_stepping.py."""

# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from typing import Any

import torch

from ..core.errors import TerrellaError
from .mujoco_model import mujoco
from .mujoco_stepping import Stepper


class WarpStepper(Stepper):
    """Worlds of one model on one CUDA device, in float32; states are CPU tensors. Contacts and LiDAR stay with MuJoCo on the CPU.
    Parameters cannot differ between worlds. TerrellaError without mujoco-warp or a GPU."""

    def __init__(self, file: mujoco.MjModel, device: str):
        super().__init__(file, {}, 1)
        try:
            import mujoco_warp
            import warp
        except ImportError as error:
            raise TerrellaError("stepping MuJoCo on a GPU needs mujoco-warp: pip install mujoco-warp.") from error
        warp.init()
        if not warp.is_cuda_available():
            raise TerrellaError("mujoco-warp finds no CUDA GPU; leave `device` out to step on the CPU.")
        self._warp, self._mjw, self._device = warp, mujoco_warp, warp.get_device(device)
        with warp.ScopedDevice(self._device):
            self._model = mujoco_warp.put_model(file)
        self._held: dict[int, Any] = {}  # batch -> its data
        self._graphs: dict[tuple[int, int], Any] = {}  # (batch, steps) -> captured graph

    def step(
        self, physics: torch.Tensor, warmstart: torch.Tensor, ctrl: torch.Tensor, values: torch.Tensor, steps: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        model, batch = self.file, len(physics)
        with self._warp.ScopedDevice(self._device):
            data = self._data(batch)
            ends = (1, 1 + model.nq, 1 + model.nq + model.nv, 1 + model.nq + model.nv + model.na)
            fields = ["qpos", "qvel", *(["act"] if model.na else [])]
            parts = {name: slice(*at) for name, at in zip(fields, zip(ends, ends[1:]))}
            held = {
                name: self._warp.to_torch(getattr(data, name)) for name in (*fields, "time", "qacc_warmstart", "ctrl")
            }
            for name, at in parts.items():
                held[name].copy_(physics[:, at])
            held["time"].copy_(physics[:, 0])
            held["qacc_warmstart"].copy_(warmstart)
            held["ctrl"].copy_(ctrl)
            self._run(data, batch, steps)
            after = physics.clone()
            for name, at in parts.items():
                after[:, at] = held[name].double().cpu()
            after[:, 0] = held["time"].double().cpu()
            sensed = self._warp.to_torch(data.sensordata).double().cpu()
            return after, sensed, held["qacc_warmstart"].double().cpu()

    def _data(self, batch: int) -> Any:
        if batch not in self._held:
            self._held[batch] = self._mjw.make_data(self.file, nworld=batch)
        return self._held[batch]

    def _run(self, data: Any, batch: int, steps: int) -> None:
        """Runs `steps` steps as one CUDA graph, captured at the first call."""
        key = batch, steps
        if key not in self._graphs:
            before = {
                name: self._warp.clone(getattr(data, name))
                for name in ("qpos", "qvel", "act", "time", "qacc_warmstart")
            }
            self._mjw.step(self._model, data)  # compiles kernels, which is not possible during a capture
            with self._warp.ScopedCapture() as capture:
                for _ in range(steps):
                    self._mjw.step(self._model, data)
            self._graphs[key] = capture.graph
            for name, value in before.items():
                self._warp.copy(getattr(data, name), value)
        self._warp.capture_launch(self._graphs[key])
