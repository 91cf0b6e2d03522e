"""Stands in for lerobot.configs.policies: config.json as an object."""

import json
from enum import Enum
from pathlib import Path
from types import SimpleNamespace

FeatureType = Enum("FeatureType", {name: name for name in ("VISUAL", "STATE", "ACTION")})
NormalizationMode = Enum("NormalizationMode", {name: name for name in ("MEAN_STD", "IDENTITY")})


def features_of(saved):
    return {
        name: SimpleNamespace(type=FeatureType(one["type"]), shape=tuple(one["shape"])) for name, one in saved.items()
    }


class PreTrainedConfig:
    @staticmethod
    def from_pretrained(folder, local_files_only):
        print("LeRobot prints whatever it likes")
        config = SimpleNamespace(**json.loads((Path(folder) / "config.json").read_text()))
        config.input_features, config.output_features = map(
            features_of, (config.input_features, config.output_features)
        )
        config.normalization_mapping = {
            kind: NormalizationMode(mode) for kind, mode in config.normalization_mapping.items()
        }
        return config
