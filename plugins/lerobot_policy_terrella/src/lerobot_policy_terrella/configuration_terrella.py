"""TerrellaConfig: what LeRobot keeps of a policy of Terrella in config.json."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

UNTRAINED = "a policy of Terrella is trained by `terrella train policy --method imitation`, not by LeRobot."


@PreTrainedConfig.register_subclass("terrella")
@dataclass
class TerrellaConfig(PreTrainedConfig):
    """The network as Terrella's policy.json describes it. The network normalises by itself, so LeRobot's processors do not."""

    network: dict[str, Any] = field(default_factory=dict)
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.network["chunk"]))

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> Any:
        raise NotImplementedError(UNTRAINED)

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        """ValueError for a config that does not come from a trained policy."""
        if not self.network:
            raise ValueError(
                f"{UNTRAINED} Then `python -m lerobot_policy_terrella RUN FOLDER` makes a folder for --policy.path."
            )
