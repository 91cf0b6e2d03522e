"""Steps batches of physics states on a GPU with `mujoco-warp` instead of `mujoco.rollout`; see mujoco_stepping.py."""

# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from copy import copy
from typing import Any

import torch

from ..core.errors import TerrellaError
from .mujoco_model import mujoco
from .mujoco_stepping import Stepper

ON_CPU = "warp:cpu"  # the device on which mujoco-warp steps without a GPU, for tests
CONTACTS = 64  # of a world, on average over the batch
BATCHES = 4  # sizes of batches whose arrays are kept


def torch_device(name: str) -> torch.device:
    """Where states lie that are stepped on a device of MujocoConfig; TerrellaError for no device."""
    try:
        device = torch.device("cpu" if name in ("", ON_CPU) else name)
        torch.zeros(1, device=device)
        return device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise TerrellaError(
            f"PyTorch has no device '{name}' here; give cuda or cuda:1 where it has one, or leave `device` out."
        ) from error


class WarpStepper(Stepper):
    """Worlds of one model on one device, in float32: physics, controls, sensors and the solver's warmstart stay there. Contacts
    and LiDAR are computed by MuJoCo on the CPU. Parameters cannot differ between worlds. TerrellaError without mujoco-warp or a
    GPU, and for a model with something that mujoco-warp lacks."""

    def __init__(self, file: mujoco.MjModel, device: str):
        super().__init__(file, {}, 1)
        try:
            import mujoco_warp
            import warp
        except ImportError as error:
            raise TerrellaError("stepping MuJoCo on a GPU needs mujoco-warp: pip install mujoco-warp.") from error
        warp.config.quiet = True
        warp.init()
        if device != ON_CPU and not warp.is_cuda_available():
            raise TerrellaError("mujoco-warp finds no CUDA GPU; leave `device` out to step on the CPU.")
        self._warp, self._mjw = warp, mujoco_warp
        self._device = warp.get_device(device.removeprefix("warp:"))
        self._fields = {"qpos": file.nq, "qvel": file.nv, **({"act": file.na} if file.na else {})}
        self._source = copy(file)  # mujoco-warp never resets a world, and does not know that it should not
        self._source.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        try:
            with warp.ScopedDevice(self._device):
                self._model = mujoco_warp.put_model(self._source)
        except (NotImplementedError, ValueError) as error:
            raise TerrellaError(
                f"mujoco-warp cannot step this model ({error}); leave `device` out to step on the CPU."
            ) from error
        self._held: dict[tuple[int, int], tuple[Any, Any]] = {}  # (batch, steps) -> its data and CUDA graph

    def step(
        self, physics: torch.Tensor, warmstart: torch.Tensor, ctrl: torch.Tensor, values: torch.Tensor, steps: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The same as `Stepper.step`, of float32 tensors on the device."""
        data, graph = self._prepared(len(physics), steps)
        held = {name: self._warp.to_torch(getattr(data, name)) for name in ("qacc_warmstart", "ctrl", "sensordata")}
        time = self._warp.to_torch(data.time)
        parts = [self._warp.to_torch(getattr(data, name)) for name in self._fields]
        time.copy_(physics[:, 0])
        for mine, given in zip(parts, physics[:, 1:].split(list(self._fields.values()), 1)):
            mine.copy_(given)
        held["qacc_warmstart"].copy_(warmstart)
        held["ctrl"].copy_(ctrl)
        if graph is None:
            self._run(data, steps)
        else:
            stream = torch.cuda.current_stream(physics.device)
            self._warp.capture_launch(graph, stream=self._warp.stream_from_torch(stream))
        after = torch.cat([time[:, None], *parts], 1)
        return after, held["sensordata"].clone(), held["qacc_warmstart"].clone()

    def _prepared(self, batch: int, steps: int) -> tuple[Any, Any]:
        """Arrays for a batch, and on a GPU `steps` steps on them as a CUDA graph."""
        if (batch, steps) not in self._held:
            if len(self._held) >= BATCHES:
                self._held.pop(next(iter(self._held)))
            rows = 6 * CONTACTS + 4 * self.file.nv + 6 * self.file.neq  # of constraints in a world
            with self._warp.ScopedDevice(self._device):
                data = self._mjw.make_data(self._source, nworld=batch, nconmax=CONTACTS, njmax=rows)
                graph = None
                if self._device.is_cuda:
                    self._run(data, 1)  # compiles kernels, which is not possible during a capture
                    with self._warp.ScopedCapture() as capture:
                        self._run(data, steps)
                    graph = capture.graph
                    self._warp.synchronize_device(self._device)
            self._held[batch, steps] = data, graph
        return self._held[batch, steps]

    def _run(self, data: Any, steps: int) -> None:
        with self._warp.ScopedDevice(self._device):
            for _ in range(steps):
                self._mjw.step(self._model, data)
