"""LerobotPolicy: a policy of LeRobot, from a folder of files, run by LeRobot's own code in a Python that has it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO, cast, final

import numpy as np
import torch

from ..core import chance
from ..core.errors import ActionError, ChannelError, CheckpointError, TerrellaError
from ..core.feature_names import features_of
from ..core.spec import Spec, dtype_of, shape_of
from ..core.world import Observation
from . import lerobot_program
from .actor import POLICY_FILE, policy_folder, read_policy

PYTHON = "TERRELLA_LEROBOT_PYTHON"  # environment variable: the Python that has lerobot
LEROBOT, KINDS = "lerobot", ("act", "diffusion")
CONFIG, WEIGHTS = "config.json", "model.safetensors"
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_ADVICE = f"install lerobot 0.4.4 in an environment of its own, and name the Python of that in {PYTHON}"
_PATIENCE_S = 10.0
_INSIDE = ("", "pretrained_model", "checkpoints/last/pretrained_model")  # of a training run of LeRobot


@dataclass(frozen=True)
class LerobotConfig:
    """What a policy of LeRobot sees and gives, from its config.json."""

    kind: str
    inputs: Mapping[str, tuple[int, ...]]
    """Feature that the environment gives -> its shape: numbers [n], pictures [3, H, W]."""
    pictures: tuple[str, ...]  # of the inputs
    action: int  # numbers of an action

    @staticmethod
    def read(folder: Path) -> LerobotConfig:
        """CheckpointError for a folder of another kind of policy, or if files are missing or damaged."""
        try:
            saved = _json(folder / CONFIG)
            if (kind := saved["type"]) not in KINDS:
                raise CheckpointError(
                    f"{folder} is a policy of LeRobot of kind '{kind}'; {' and '.join(KINDS)} run here."
                )
            processors = [_json(folder / name) for name in PROCESSORS if (folder / name).is_file()]
            steps = [step for one in processors for step in one["steps"]]
            needed = (WEIGHTS, *PROCESSORS, *(step["state_file"] for step in steps if "state_file" in step))
            if missing := [name for name in needed if not (folder / name).is_file()]:
                older = "; LeRobot before 0.4 wrote none: its lerobot.processor.migrate_policy_normalization makes them"
                raise CheckpointError(
                    f"{folder} lacks {', '.join(missing)}{older * any(name in PROCESSORS for name in missing)}. "
                    "Copy the whole folder."
                )
            renamed = {new: old for step in steps for old, new in step["config"].get("rename_map", {}).items()}
            features = {renamed.get(name, name): about for name, about in saved["input_features"].items()}
            shapes = {name: tuple(map(int, about["shape"])) for name, about in features.items()}
            pictures = tuple(name for name, about in features.items() if about["type"] == "VISUAL")
            return LerobotConfig(kind, shapes, pictures, int(saved["output_features"]["action"]["shape"][0]))
        except (OSError, LookupError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(
                f"{folder} is damaged: its JSON files do not describe a policy of LeRobot ({error})."
            ) from error

    def channels(self, spec: Spec) -> dict[str, str]:
        """Input -> the channel of a world that holds it: by its name in recordings, else the only one left of its form.
        ActionError for other actions, ChannelError with the inputs that the world lacks."""
        if self.action != (width := int(np.prod(shape_of(spec.action)))):
            raise ActionError(
                f"the policy of LeRobot gives actions of {self.action} numbers, and {spec.name} takes {width} ({spec.action})."
            )
        named = {feature: channel for channel, feature in features_of(spec.recorded).items()}
        fits = {name: [at for at in spec.recorded if self._fits(name, spec, at)] for name in self.inputs}
        chosen = {name: named[name] for name in self.inputs if named.get(name) in fits[name]}
        for name in self.inputs.keys() - chosen.keys():
            rivals = [one for one in self.inputs if one not in chosen and fits[one] == fits[name]]
            left = [at for at in fits[name] if at not in chosen.values()]
            if len(rivals) == len(left) == 1 and name not in named:
                chosen[name] = left[0]
        if lacking := [name for name in self.inputs if name not in chosen]:
            wanted = ", ".join(f"{name} {self.inputs[name]}" for name in lacking)
            shown = ", ".join(f"{feature} {shape_of(spec.channels[channel])}" for feature, channel in named.items())
            raise ChannelError(
                f"the policy of LeRobot sees {wanted}, which {spec.name} lacks or shows more than once; it shows {shown}. "
                f"A rename_map in {PROCESSORS[0]} gives an input another name."
            )
        return {name: chosen[name] for name in self.inputs}

    def _fits(self, name: str, spec: Spec, channel: str) -> bool:
        shape, picture = shape_of(spec.channels[channel]), dtype_of(spec.channels[channel]) == np.uint8
        if name in self.pictures:
            return picture and len(shape) == 3 and shape[2] == 3
        return channel not in ("reward", "done") and len(shape) < 2 and np.prod(shape) == np.prod(self.inputs[name])


def lerobot_folder(folder: str | Path) -> Path | None:
    """Where a folder, or that of a training run of LeRobot, holds one of its policies; None where it does not."""
    for inner in _INSIDE:
        place = Path(folder) / inner
        if (place / CONFIG).is_file() and not (place / POLICY_FILE).exists():
            try:
                saved = _json(place / CONFIG)
            except (OSError, ValueError):
                saved = (
                    {"type": "", "input_features": {}} if (place / WEIGHTS).exists() else None
                )  # damaged: see `read`
            if isinstance(saved, dict) and "type" in saved and "input_features" in saved:
                return place
    return None


def kind_of_policy(folder: str | Path) -> Any:
    """The kind of the policy in a folder or in that of its training run, LEROBOT for one of LeRobot. CheckpointError if there is
    none."""
    return LEROBOT if lerobot_folder(folder) else read_policy(policy_folder(folder)).get("kind")


@final
class LerobotPolicy:
    """A Policy of LeRobot for the actions of `spec`. Actions beyond the limits are clamped, of buttons and choices rounded.

    Its memory holds a RememberedMoment for each episode: what LeRobot's queues held then, which lies in LeRobot's process. LeRobot
    draws each episode's noise from a seed of its own, so that a batch equals its single episodes.
    """

    def __init__(self, process: LerobotProcess, config: LerobotConfig, spec: Spec):
        self.process, self.config, self.spec = process, config, spec
        self.channels = config.channels(spec)

    @property
    def sees(self) -> tuple[str, ...]:
        """The channels to show it."""
        return tuple(dict.fromkeys(self.channels.values()))

    def begin(self, batch: int, rng: torch.Generator) -> list[RememberedMoment]:
        return [RememberedMoment(self.process, 0)] * batch

    def act(
        self, observation: Observation, memory: list[RememberedMoment], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[RememberedMoment]]:
        """The actions [B, *action.shape], on the CPU; TerrellaError if LeRobot fails."""
        if missing := [name for name in self.sees if name not in observation]:
            raise ChannelError(f"the policy sees {', '.join(missing)}, which the observation lacks.")
        seen = {name: torch.as_tensor(observation[channel]).cpu() for name, channel in self.channels.items()}
        seen = {
            name: value if name in self.config.pictures else value.reshape(len(memory), *self.config.inputs[name])
            for name, value in seen.items()
        }
        sizes = {name: self.config.inputs[name][1:] for name in self.config.pictures}
        question = {"moments": [one.number for one in memory], "sizes": sizes}
        actions, moments = self.process.act({**question, "seeds": chance.seeds(len(memory), rng).tolist()}, seen)
        low, high = self.spec.action_limits
        values = actions.double().numpy().reshape(-1, *shape_of(self.spec.action)).clip(low, high)
        kind = dtype_of(self.spec.action)
        return torch.from_numpy((values if kind.kind == "f" else values.round()).astype(kind)), moments

    @staticmethod
    def load(folder: str | Path, spec: Spec) -> LerobotPolicy:
        """The policy of a folder (`lerobot_folder`). CheckpointError if it is foreign, lacks files, normalises wrongly or no Python
        has lerobot; ActionError or ChannelError if `spec` has other actions or lacks a channel."""
        place = lerobot_folder(folder)
        if place is None:
            raise CheckpointError(f"{folder} holds no policy of LeRobot (no {CONFIG}).")
        config = LerobotConfig.read(place)
        config.channels(spec)  # what does not fit is refused before LeRobot is started
        return LerobotPolicy(_process(place), config, spec)


class RememberedMoment:
    """What a policy remembers at a moment of an episode; LeRobot's process forgets it when nothing refers to it any more."""

    def __init__(self, process: LerobotProcess, number: int):
        self.number = number
        if number:
            weakref.finalize(self, process.forgotten.append, number).atexit = False


class LerobotProcess:
    """A Python with lerobot that runs one policy (lerobot_program.py). CheckpointError if it does not load."""

    def __init__(self, python: str, folder: Path):
        self.folder, self.forgotten, self._turn = folder, list[int](), threading.Lock()
        self._log = tempfile.TemporaryFile()
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONSAFEPATH": "1"}
        command = [python, lerobot_program.__file__, str(folder)]
        pipe = subprocess.PIPE
        try:
            self._running = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=self._log, env=environment, start_new_session=True
            )  # where no Ctrl-C reaches it
        except OSError as error:
            self._log.close()
            raise CheckpointError(f"{python} cannot be started ({error}): {_ADVICE}.") from error
        self._into, self._out = cast(BinaryIO, self._running.stdin), cast(BinaryIO, self._running.stdout)
        self._end = weakref.finalize(self, _end, self._running, self._log)
        try:
            self._answer()
        except TerrellaError as error:
            if "No module named" in str(error):
                raise CheckpointError(
                    f"{python} does not run {folder} ({str(error).rstrip('.')}): {_ADVICE}."
                ) from None
            raise CheckpointError(f"{folder} does not load in LeRobot: {error}") from None

    @property
    def ended(self) -> bool:
        return self._running.poll() is not None

    def act(self, question: Mapping[str, Any], seen: Observation) -> tuple[torch.Tensor, list[RememberedMoment]]:
        """The actions [B, A] and the moments after them; TerrellaError if LeRobot fails."""
        with self._turn:
            forgotten = [self.forgotten.pop() for _ in range(len(self.forgotten))]
            try:
                lerobot_program.write(self._into, {**question, "forget": forgotten}, seen)
                text, tensors = self._answer()
            except BrokenPipeError:
                raise TerrellaError(f"LeRobot's process has ended{self._last_words()}") from None
            except KeyboardInterrupt:
                self._end()  # half an answer may be on its way
                raise
        return tensors[lerobot_program.ACTION], [RememberedMoment(self, number) for number in text["moments"]]

    def _answer(self) -> tuple[dict[str, Any], Observation]:
        answer = lerobot_program.read(self._out)
        if answer is None:
            raise TerrellaError(f"LeRobot's process has ended{self._last_words()}")
        if "error" in answer[0]:
            raise TerrellaError(f"LeRobot fails with {answer[0]['error']}.")
        return answer

    def _last_words(self) -> str:
        """The last line that it printed."""
        with suppress(subprocess.TimeoutExpired):
            self._running.wait(_PATIENCE_S)
        self._log.seek(0)
        lines = self._log.read().decode("utf-8", "replace").strip().splitlines()
        return f": {lines[-1].strip()}" if lines else "."


def _process(place: Path) -> LerobotProcess:
    """The process that runs the policy of a folder, one for all who load it."""
    changed = tuple((file.name, file.stat().st_mtime_ns) for file in sorted(place.iterdir()))
    if _started(python := _python(place), place.resolve(), changed).ended:
        _started.cache_clear()
    return _started(python, place.resolve(), changed)


@lru_cache(maxsize=4)
def _started(python: str, folder: Path, changed: object) -> LerobotProcess:
    return LerobotProcess(python, folder)


def _python(place: Path) -> str:
    installed = find_spec("lerobot")  # without an origin it is a folder of that name where one works
    python = os.environ.get(PYTHON) or (sys.executable if installed and installed.origin else "")
    if not python:
        raise CheckpointError(f"{place} is a policy of LeRobot, which runs in LeRobot's own code: {_ADVICE}.")
    return python


def _end(process: subprocess.Popen, log: BinaryIO) -> None:
    process.kill()  # it holds nothing to save, and may be busy for long
    process.wait()
    for pipe in filter(None, (process.stdin, process.stdout, log)):
        with suppress(OSError):  # of what was not written
            pipe.close()


def _json(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))
