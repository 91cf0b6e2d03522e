"""A recorded episode as a World: it shows the recorded frames in order, whatever the action."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from gymnasium import spaces

from ..core.errors import ObservationError, TerrellaError
from ..core.spec import DONE, Camera, Spec, shape_of, torch_dtype_of
from ..core.state import State


class ReplayWorld:
    """One episode of T + 1 frames.

    channels: name -> array or tensor [T + 1, ...], row t as a World renders it at frame t: `reward` and `done` are those of the
    step to frame t; row 0 has 0 and False. Memory-mapped arrays are read on demand. actions: [T, *action.shape], from frame t to t
    + 1. action: the action space; `imagine` checks its actions, and otherwise ignores them. spaces_given: name -> space, where the
    default (the dtype's whole range) is too wide.

    `done` is True on the last frame, and where the recording says so. After the end the last frame stays, with reward 0.
    The world is forkable, for any batch. float16 and float64 channels are shown as float32. TerrellaError where lengths differ."""

    def __init__(
        self,
        channels: Mapping[str, np.ndarray | torch.Tensor],
        actions: np.ndarray | torch.Tensor,
        action: spaces.Space,
        dt_s: float,
        *,
        name: str = "replay",
        spaces_given: Mapping[str, spaces.Space] | None = None,
        units: Mapping[str, str] | None = None,
        cameras: Mapping[str, Camera] | None = None,
    ):
        lengths = {key: len(array) for key, array in channels.items()}
        if not lengths or set(lengths.values()) != {len(actions) + 1}:
            raise TerrellaError(
                f"an episode of {len(actions)} actions has {len(actions) + 1} frames in each channel; got {lengths}."
            )
        self.actions = actions
        self._arrays = dict(channels)
        self._last = len(actions)
        given = {"done": DONE, **(spaces_given or {})}
        self.spec = Spec(
            name=name,
            action=action,
            channels={key: given.get(key) or _space_of(array) for key, array in channels.items()}
            | {"done": given["done"]},
            observes=(),
            dt_s=dt_s,
            units=units or {},
            cameras=cameras or {},
            card={"what": f"a recorded episode of {self._last} steps", "kind": "recording"},
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        """The first frame, `batch` times."""
        if batch < 1:
            raise TerrellaError(f"{self.spec.name} starts a batch of at least 1; got {batch}.")
        return State({"frame": torch.zeros(batch, dtype=torch.int64), "beyond": torch.zeros(batch, dtype=torch.bool)})

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """The prior, or the first frame: a recording cannot be set from an observation."""
        if observation:
            raise ObservationError(
                f"{self.spec.name} is a recording and accepts no observation; pass an empty mapping."
            )
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """The next recorded frame; a frame that is done stays."""
        self.spec.check_action(action, state.batch)
        done = self._done(state["frame"])
        return State({"frame": torch.where(done, state["frame"], state["frame"] + 1), "beyond": done})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        seen = {
            name: self._done(state["frame"]) if name == "done" else self._read(name, state["frame"])
            for name in channels
        }
        if "reward" in seen:
            seen["reward"] = torch.where(state["beyond"], torch.zeros_like(seen["reward"]), seen["reward"])
        return seen

    def _done(self, frame: torch.Tensor) -> torch.Tensor:
        last = frame >= self._last
        return last | self._read("done", frame) if "done" in self._arrays else last

    def _read(self, name: str, frame: torch.Tensor) -> torch.Tensor:
        rows, space = self._arrays[name], self.spec.channels[name]
        index = frame.cpu()
        picked = rows[index] if isinstance(rows, torch.Tensor) else torch.from_numpy(np.array(rows[index.numpy()]))
        return picked.reshape(len(index), *shape_of(space)).to(torch_dtype_of(space))


def _space_of(array: np.ndarray | torch.Tensor) -> spaces.Box:
    """The space of the whole range of the array's dtype."""
    row = np.asarray(array[:1])
    shape, dtype = row.shape[1:], row.dtype
    if dtype.kind == "b":
        return spaces.Box(0, 1, shape, np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if dtype.kind in "iu":
        return spaces.Box(np.iinfo(dtype).min, np.iinfo(dtype).max, shape, dtype.type)
    return spaces.Box(-np.inf, np.inf, shape, np.float32)
