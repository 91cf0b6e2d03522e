"""A training run on disk: the state from which it resumes exactly, replaced as a whole at every save; and its log."""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from ..core.errors import TrainingError
from ..core.files import remedy_of, replacing, write_text

LOG = "log.jsonl"


def check_run(out: Path, settings: Mapping[str, Any]) -> None:
    """TrainingError for settings with which nothing is learned, or a folder that holds a recording."""
    for name in ("steps", "batch", "updates"):
        if (count := settings.get(name)) is not None and count < 1:
            raise TrainingError(f"--{name} is 1 or more; got {count}.")
    rate = settings.get("learning_rate")
    if rate is not None and not 0 < rate < math.inf:
        raise TrainingError(f"--learning-rate is above 0, as in --learning-rate 0.001; got {rate:g}.")
    if (out / "meta" / "info.json").exists():
        raise TrainingError(f"{out} holds a recording; give another --out.")


def resume_file(folder: Path, stage: str) -> Path:
    return folder / f"resume-{stage}.safetensors"


def save_run(
    path: Path, modules: Mapping[str, torch.nn.Module], optimisers: Mapping[str, torch.optim.Optimizer], facts: dict
) -> None:
    """Modules, optimisers and `facts` (JSON) in one file; a kill while saving leaves the last save in place."""
    tensors = {f"{name}/{key}": value for name, module in modules.items() for key, value in module.state_dict().items()}
    for name, optimiser in optimisers.items():
        for number, slots in optimiser.state_dict()["state"].items():
            tensors |= {f"{name}/{number}/{slot}": torch.as_tensor(value) for slot, value in slots.items()}
    whole = {key: value.detach().cpu().clone().contiguous() for key, value in tensors.items()}
    try:
        with replacing(path) as staged:
            save_file(whole, staged, metadata={"facts": json.dumps(facts)})
    except (OSError, SafetensorError) as error:
        raise TrainingError(
            f"{path.parent} cannot be written ({error}); {remedy_of(error)} and run the same command again, or give another --out."
        ) from error


def load_run(
    path: Path, modules: Mapping[str, torch.nn.Module], optimisers: Mapping[str, torch.optim.Optimizer]
) -> dict | None:
    """Restores what `save_run` wrote and returns its facts; None if there is no such file yet."""
    if not path.exists():
        return None
    try:
        tensors, facts = load_file(path), _facts(path)
        for name, module in modules.items():
            module.load_state_dict({k[len(name) + 1 :]: v for k, v in tensors.items() if k.startswith(f"{name}/")})
        for name, optimiser in optimisers.items():
            state: dict[int, dict] = {}
            for key, value in tensors.items():
                if key.startswith(f"{name}/"):
                    _, number, slot = key.split("/")
                    state.setdefault(int(number), {})[slot] = value
            optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
        return facts
    except (OSError, SafetensorError, KeyError, ValueError, RuntimeError, TypeError) as error:
        first = str(error).splitlines()[0]
        raise TrainingError(
            f"{path} is not a run of this recipe ({first}); give another --out, or delete it."
        ) from error


def stages_of(folder: Path) -> Iterator[dict]:
    """The facts of those stages of a run whose files can be read."""
    for path in sorted(folder.glob("resume-*.safetensors")):
        try:
            yield _facts(path)
        except (OSError, SafetensorError, KeyError, ValueError, TypeError):
            continue


def _facts(path: Path) -> dict:
    with safe_open(path, "pt") as file:
        return json.loads(file.metadata()["facts"])


def write_log(folder: Path, line: Mapping[str, object]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with open(folder / LOG, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        raise TrainingError(
            f"{folder / LOG} cannot be written ({error}); {remedy_of(error)} and run the same command again, or give another --out."
        ) from error


def trim_log(folder: Path, stage: str, step: int) -> None:
    """Drops the lines of `stage` after `step`, the last saved one, from the log: those steps will be done again."""
    path = folder / LOG
    if not path.exists():
        return
    kept = [line for line in path.read_text(encoding="utf-8").splitlines() if _before(line, stage, step)]
    write_text(path, "".join(f"{line}\n" for line in kept))


def _before(line: str, stage: str, step: int) -> bool:
    try:
        entry = json.loads(line)
        return entry.get("stage") != stage or entry["step"] <= step
    except (ValueError, KeyError, AttributeError):
        return False  # a line that was cut by a kill
