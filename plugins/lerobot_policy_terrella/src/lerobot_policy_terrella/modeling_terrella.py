"""TerrellaPolicy: a policy that Terrella learned by imitation, as a PreTrainedPolicy of LeRobot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy

from terrella.act.actor_network import ActorConfig
from terrella.act.imitation import ImitationActor, load_imitation_network
from terrella.act.imitation_network import TEXT, ImitationConfig, ImitationNetwork, is_picture
from terrella.core import Spec
from terrella.core.feature_names import STATE, features_of
from terrella.core.instruction import text_to_bytes
from terrella.core.spec import BUTTONS, CHOICE
from terrella.core.spec import TEXT as TEXT_SPACE

from .configuration_terrella import UNTRAINED, TerrellaConfig
from .processor_terrella import make_terrella_pre_post_processors

TASK = "task"


class TerrellaPolicy(PreTrainedPolicy):
    """Acts on LeRobot's batches: `observation.images.NAME` float [B, 3, H, W] from 0 to 1 for the channel rgb.NAME (of the main
    camera observation.images.rgb), numbers as Terrella's recordings name them (the channel `observation` is observation.state),
    and `task` for the instruction. Noise is drawn from torch's global generator, which LeRobot seeds."""

    config_class = TerrellaConfig
    name = "terrella"

    def __init__(self, config: TerrellaConfig, **_: Any):
        super().__init__(config)
        config.validate_features()
        settings = _tuples(config.network)
        actor = ActorConfig(**settings["actor"])
        self.network = ImitationNetwork(ImitationConfig(**{**settings, "actor": actor}))
        self.network.eval().requires_grad_(False)
        self.actor = ImitationActor(self.network, spec_of(self.network.config))
        self.features, self.shapes = features_of_policy(self.network.config), dict(actor.sees)
        self.reset()

    def reset(self) -> None:
        """To be called when an episode begins."""
        self._memory = None

    @torch.no_grad()
    def select_action(self, batch: Mapping[str, Any], **_: Any) -> torch.Tensor:
        """The actions [B, A] of this step. ValueError if the batch lacks a feature, or has another size than at the last reset."""
        seen = self._observation(batch)
        action, self._memory = self.actor.act(seen, self._begun(seen), torch.default_generator)
        return action.float().reshape(len(action), -1)

    @torch.no_grad()
    def predict_action_chunk(self, batch: Mapping[str, Any], **_: Any) -> torch.Tensor:
        """A new chunk [B, chunk, A] for this step; the first of it counts as done."""
        seen, config = self._observation(batch), self.network.config
        memory = self._begun(seen)
        anew = torch.where(memory["taken"] < 0, memory["taken"], config.execute)
        _, self._memory = self.actor.act(seen, memory.replace(taken=anew), torch.default_generator)
        actions = config.decode(self._memory["chunk"].flatten(0, 1), self.actor.spec)
        return actions.float().reshape(memory.batch, config.chunk, -1)

    def forward(self, batch: Mapping[str, Any]) -> Any:
        raise NotImplementedError(UNTRAINED)

    def get_optim_params(self) -> Any:
        raise NotImplementedError(UNTRAINED)

    def _begun(self, seen: Mapping[str, torch.Tensor]) -> Any:
        batch = len(next(iter(seen.values())))
        if self._memory is None:
            self._memory = self.actor.begin(batch, torch.default_generator)
        if self._memory.batch != batch:
            raise ValueError(
                f"this episode began with {self._memory.batch} observations, not {batch}: call reset() first."
            )
        return self._memory

    def _observation(self, batch: Mapping[str, Any]) -> dict[str, torch.Tensor]:
        """Terrella's channels of a batch of LeRobot."""
        needed = {**self.features, **({TEXT: TASK} if self.network.words is not None else {})}
        if lacking := [feature for feature in needed.values() if batch.get(feature) is None]:
            held = ", ".join(name for name, value in batch.items() if value is not None)
            raise ValueError(f"the policy sees {', '.join(lacking)}, which the batch lacks; it holds {held}.")
        seen = {channel: self._channel(channel, batch[feature]) for channel, feature in self.features.items()}
        if TEXT in needed:
            texts = [batch[TASK]] if isinstance(batch[TASK], str) else batch[TASK]
            seen[TEXT] = torch.from_numpy(np.stack([text_to_bytes(text) for text in texts]))
        return seen

    def _channel(self, channel: str, value: torch.Tensor) -> torch.Tensor:
        """The values [B, ...] of a channel; a lone observation gets its batch axis."""
        shape = self.shapes[channel]
        if is_picture(shape):
            value = value if value.ndim == 4 else value[None]
            return (255 * value).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
        value = value if value.ndim > max(len(shape), 1) else value[None]
        if value[0].numel() != int(np.prod(shape)):
            raise ValueError(
                f"the policy sees {self.features[channel]} {shape}, and the batch holds {tuple(value.shape)}."
            )
        return value.reshape(len(value), *shape)


def from_run(folder: str | Path) -> TerrellaPolicy:
    """The policy of a folder of Terrella, or of its training run. CheckpointError if it is not one learned by imitation."""
    network, _ = load_imitation_network(folder)
    config = network.config
    names = features_of_policy(config)
    inputs = {names[channel]: _feature(shape) for channel, shape in config.actor.sees}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (len(config.actor.low),))}
    policy = TerrellaPolicy(TerrellaConfig(input_features=inputs, output_features=outputs, network=asdict(config)))
    policy.network.load_state_dict(network.state_dict())
    return policy.to(policy.config.device).eval()


def save(policy: TerrellaPolicy, folder: str | Path) -> None:
    """Writes the folder that LeRobot's --policy.path takes."""
    for part in (policy, *make_terrella_pre_post_processors(policy.config)):
        part.save_pretrained(folder)


def features_of_policy(config: ImitationConfig) -> dict[str, str]:
    """Channel -> feature. LeRobot's processors leave out a feature `observation`, so that channel is observation.state."""
    features = features_of(name for name, _ in config.actor.sees)
    if STATE not in features.values():
        features = {channel: STATE if feature == "observation" else feature for channel, feature in features.items()}
    return features


def spec_of(config: ImitationConfig) -> Spec:
    """A Spec with the actions and channels of a policy."""
    actor = config.actor
    low, high = (np.array(limit).reshape(actor.shape) for limit in (actor.low, actor.high))
    if actor.mode == CHOICE:
        counts, first = (high - low + 1).astype(np.int64), low.astype(np.int64)
        one = actor.shape == ()
        action = spaces.Discrete(int(counts), start=int(first)) if one else spaces.MultiDiscrete(counts, start=first)
    elif actor.mode == BUTTONS:
        action = spaces.MultiBinary(actor.shape)
    else:
        action = spaces.Box(low, high, dtype=np.float64)
    channels = {
        name: spaces.Box(0, 255, shape, np.uint8) if len(shape) == 3 else spaces.Box(-np.inf, np.inf, shape, np.float32)
        for name, shape in actor.sees
    }
    channels |= {TEXT: TEXT_SPACE} if config.vocabulary else {}
    return Spec("LeRobot", action, channels, (), 1.0)


def _feature(shape: tuple[int, ...]) -> PolicyFeature:
    if is_picture(shape):
        return PolicyFeature(FeatureType.VISUAL, (shape[2], *shape[:2]))
    return PolicyFeature(FeatureType.STATE, shape or (1,))


def _tuples(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _tuples(inner) for name, inner in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value
