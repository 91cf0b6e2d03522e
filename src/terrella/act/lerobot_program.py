"""A program for a Python that has lerobot: it runs a policy of LeRobot in LeRobot's own code and is spoken to over its pipes.

It imports nothing of Terrella. Questions and answers are a line of JSON each, then as many bytes of safetensors as that says.
"""

import copy
import json
import os
import sys
from collections import deque
from collections.abc import Mapping
from contextlib import nullcontext
from importlib import import_module
from typing import Any, BinaryIO

import torch
from safetensors.torch import load, save
from torch.nn import functional as F

ACTION, AS_IS = "action", "IDENTITY"


class HostedPolicy:
    """The policy of a folder, with what it remembers at moments of its episodes, by number; 0 is the start of any."""

    def __init__(self, folder: str):
        factory, configs = import_module("lerobot.policies.factory"), import_module("lerobot.configs.policies")
        config = configs.PreTrainedConfig.from_pretrained(folder, local_files_only=True)
        if hasattr(config, "pretrained_backbone_weights"):
            config.pretrained_backbone_weights = None  # the folder holds all weights, and none is fetched
        policy = factory.get_policy_class(config.type).from_pretrained(folder, config=config, strict=True)
        device = {"device_processor": {"device": config.device}}
        self.before, self.after = factory.make_pre_post_processors(config, folder, preprocessor_overrides=device)
        check_normalisation(config, self.before, self.after)
        policy.reset()
        self.config, self.moments, self.newest = config, {0: policy}, 0

    def act(self, question: Mapping[str, Any], seen: Mapping[str, torch.Tensor]) -> tuple[list[int], torch.Tensor]:
        """The moments after this step of B episodes, and their actions [B, A]. question: `moments` and `seeds` of the episodes,
        `sizes` (height and width) of pictures. seen: feature -> [B, ...], pictures uint8 [B, H, W, 3]."""
        after, actions = [], []
        for entry, (moment, seed) in enumerate(zip(question["moments"], question["seeds"])):
            policy: Any = twin(self.moments[moment])
            torch.manual_seed(seed)
            given = {name: _input(value[entry], question["sizes"].get(name)) for name, value in seen.items()}
            half = torch.autocast(self.config.device.partition(":")[0]) if self.config.use_amp else nullcontext()
            with torch.inference_mode(), half:
                actions.append(self.after(policy.select_action(self.before(given)))[0].float().cpu())
            self.newest += 1
            self.moments[self.newest] = policy
            after.append(self.newest)
        return after, torch.stack(actions)

    def forget(self, moments: list[int]) -> None:
        for moment in moments:
            del self.moments[moment]


def twin(policy: torch.nn.Module) -> torch.nn.Module:
    """A copy of a policy with queues of its own; the weights are shared."""
    copied = copy.copy(policy)
    own = vars(policy).keys() - vars(torch.nn.Module()).keys() - {"config"}
    vars(copied).update({name: _copied(vars(policy)[name]) for name in own})
    return copied


def _copied(value: Any) -> Any:
    if isinstance(value, deque):
        return copy.copy(value)  # what is queued is never changed
    return {key: _copied(one) for key, one in value.items()} if isinstance(value, dict) else copy.deepcopy(value)


def _input(value: torch.Tensor, size: list[int] | None) -> torch.Tensor:
    """What LeRobot's preprocessor takes of one episode: float32 numbers, and pictures [3, h, w] from 0 to 1."""
    if size is None:
        return value.float()
    unit = value.permute(2, 0, 1).float() / 255
    return unit if list(unit.shape[1:]) == size else F.interpolate(unit[None], tuple(size), mode="area")[0]


def check_normalisation(config: Any, before: Any, after: Any) -> None:
    """ValueError if statistics are missing or the two processors do not invert each other, where LeRobot itself runs on."""
    for processor, features in ((before, config.input_features), (after, config.output_features)):
        steps = [step for step in processor.steps if hasattr(step, "norm_map")]
        for name, feature in features.items():
            mode = getattr(config.normalization_mapping.get(feature.type.value), "value", AS_IS)
            stated = {kind.value: how.value for step in steps for kind, how in step.norm_map.items()}
            if stated.get(feature.type.value, AS_IS) != mode:
                raise ValueError(
                    f"config.json normalises {feature.type.value} by {mode}, and {processor.name}.json by "
                    f"{stated.get(feature.type.value, AS_IS)}"
                )
            if mode != AS_IS and not any(name in step.stats for step in steps):
                raise ValueError(f"{processor.name}.json holds no statistics of {name}, which is normalised by {mode}")
    seen = {name: torch.zeros(tuple(feature.shape)) for name, feature in config.input_features.items()}
    action = after(torch.linspace(-0.9, 0.9, config.output_features[ACTION].shape[0])[None])
    made = before({**seen, ACTION: action[0]})
    if broken := [name for name in (*seen, ACTION) if name in made and not torch.isfinite(made[name]).all()]:
        raise ValueError(f"the statistics of {', '.join(broken)} give numbers that are not finite")
    again = after(made[ACTION].reshape(1, -1))
    if not torch.allclose(again, action, rtol=1e-3, atol=1e-4):
        raise ValueError(
            f"the statistics of actions differ: normalised by {before.name}.json and back by {after.name}.json, "
            f"{action[0].tolist()} becomes {again[0].tolist()}"
        )


def _import_torchvision() -> None:
    """Its compiled operators may be missing beside a CPU's torch, which stops the import. LeRobot's policies do not call them."""
    try:
        import_module("torchvision")
    except RuntimeError:
        for module in [name for name in sys.modules if name.startswith("torchvision")]:
            del sys.modules[module]
        library = torch.library.Library("torchvision", "DEF")
        library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        import_module("torchvision")
        _import_torchvision.__dict__["kept"] = library  # it lasts as long as its operators are needed
    except ModuleNotFoundError:
        pass  # LeRobot names what it needs


def write(pipe: BinaryIO, text: Mapping[str, Any], tensors: Mapping[str, torch.Tensor] | None = None) -> None:
    """One question or answer."""
    payload = save({name: value.contiguous() for name, value in tensors.items()}) if tensors else b""
    pipe.write(json.dumps({**text, "bytes": len(payload)}).encode() + b"\n" + payload)
    pipe.flush()


def read(pipe: BinaryIO) -> tuple[dict[str, Any], dict[str, torch.Tensor]] | None:
    """The next question or answer; None where the other side has ended."""
    line = pipe.readline()
    if not line.endswith(b"\n"):
        return None
    text = json.loads(line)
    payload = pipe.read(text["bytes"])
    if len(payload) < text["bytes"]:
        return None
    return text, load(payload) if payload else {}


def main(folder: str) -> None:
    """Loads the policy, says so, and answers until its input is closed."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what LeRobot prints is no answer
    try:
        _import_torchvision()
        policy = HostedPolicy(folder)
    except Exception as error:
        write(answers, {"error": _sentence(error)})
        raise
    write(answers, {})
    while question := read(sys.stdin.buffer):
        try:
            policy.forget(question[0]["forget"])
            moments, actions = policy.act(*question)
            write(answers, {"moments": moments}, {ACTION: actions})
        except Exception as error:
            write(answers, {"error": _sentence(error)})


def _sentence(error: Exception) -> str:
    text = " ".join(str(error).split()) or "no reason given"
    return f"{type(error).__name__}: {text[:600]}"


if __name__ == "__main__":
    main(sys.argv[1])
