"""A training run on disk: what is needed to go on exactly where it stopped, replaced whole at every save."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from ..core.errors import TrainingError

STATE = "resume.safetensors"


def save_run(
    folder: Path, modules: dict[str, torch.nn.Module], optimisers: dict[str, torch.optim.Optimizer], facts: dict
) -> None:
    """Modules, optimisers and `facts` (JSON) in one file; a kill while saving leaves the last save in place."""
    tensors = {f"{name}/{key}": value for name, module in modules.items() for key, value in module.state_dict().items()}
    for name, optimiser in optimisers.items():
        for number, slots in optimiser.state_dict()["state"].items():
            tensors |= {f"{name}/{number}/{slot}": torch.as_tensor(value) for slot, value in slots.items()}
    whole = {key: value.detach().cpu().clone().contiguous() for key, value in tensors.items()}
    try:
        save_file(whole, folder / f"{STATE}.partial", metadata={"facts": json.dumps(facts)})
        (folder / f"{STATE}.partial").replace(folder / STATE)
    except (OSError, SafetensorError) as error:
        raise TrainingError(
            f"{folder} cannot be written ({error}); free some space and run the same command again."
        ) from error


def load_run(
    folder: Path, modules: dict[str, torch.nn.Module], optimisers: dict[str, torch.optim.Optimizer]
) -> dict | None:
    """Restores what `save_run` wrote and returns its facts; None where the folder holds no run yet."""
    path = folder / STATE
    if not path.exists():
        return None
    try:
        from safetensors import safe_open

        tensors = load_file(path)
        with safe_open(path, "pt") as file:
            facts = json.loads(file.metadata()["facts"])
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
