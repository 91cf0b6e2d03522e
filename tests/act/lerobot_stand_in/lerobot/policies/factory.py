"""Stands in for lerobot.policies.factory: a policy with a queue of actions, and processors that normalise."""

import json
from collections import deque
from pathlib import Path

import torch
from safetensors.torch import load_file

from lerobot.configs.policies import FeatureType, NormalizationMode


class Policy(torch.nn.Module):
    """Chunks of three actions: weights @ (state, brightness) + the step in the chunk; where it is bright, noise is added."""

    def __init__(self, config):
        super().__init__()
        self.config, self.weights = config, torch.nn.Parameter(torch.zeros(2, 3))

    @classmethod
    def from_pretrained(cls, folder, config, strict):
        policy = cls(config)
        policy.load_state_dict(load_file(Path(folder) / "model.safetensors"), strict=strict)
        return policy.eval()

    def reset(self):
        self._queue = deque()

    def select_action(self, batch):
        if not self._queue:
            seen = torch.cat([batch["observation.state"], batch["observation.images.rgb"].mean((1, 2, 3))[:, None]], 1)
            if seen[0, 0] > 1e6:
                raise RuntimeError("size mismatch")
            chunk = seen @ self.weights.T + (0.5 * torch.randn(1, 2) if seen[0, 2] > 1 else 0)
            self._queue.extend(chunk + 0.1 * step for step in range(3))
        return self._queue.popleft()


class Step:
    def __init__(self, saved, folder):
        self.norm_map = {
            FeatureType(kind): NormalizationMode(mode) for kind, mode in saved["config"]["norm_map"].items()
        }
        self.stats = {}
        for name, value in load_file(folder / saved["state_file"]).items():
            feature, _, what = name.rpartition(".")
            self.stats.setdefault(feature, {})[what] = value


class Processor:
    def __init__(self, folder, name):
        saved = json.loads((Path(folder) / f"{name}.json").read_text())
        self.name, self.steps = name, [Step(one, Path(folder)) for one in saved["steps"] if "state_file" in one]


class Before(Processor):
    def __call__(self, batch):
        stats = self.steps[0].stats
        done = {
            name: (x - stats[name]["mean"]) / stats[name]["std"] if name in stats else x for name, x in batch.items()
        }
        return {name: value if value.ndim == 4 else value[None] for name, value in done.items()}


class After(Processor):
    def __call__(self, action):
        stats = self.steps[0].stats["action"]
        return action * stats["std"] + stats["mean"]


def get_policy_class(kind):
    return {"act": Policy}[kind]


def make_pre_post_processors(config, folder, preprocessor_overrides):
    return Before(folder, "policy_preprocessor"), After(folder, "policy_postprocessor")
