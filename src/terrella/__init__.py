"""Terrella: worlds that are learned from recordings, played in a browser, planned in, and measured.

`import terrella` imports nothing heavy and configures nothing; each name below is imported when it is first used.
"""

# ruff: noqa: F401  (imports for type checkers; `__all__` is computed)
from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .version import __version__

if TYPE_CHECKING:
    from .act.planning import SearchConfig
    from .core import Spec, State, World, check_world, make_rng, rollout
    from .core.env import as_env
    from .learn.recipes.adapt import AdaptConfig
    from .learn.recipes.latent import LatentTraining
    from .learn.recipes.policy import Practice
    from .learn.recipes.video import TrainConfig
    from .library import as_sb3, load, load_policy, worlds
    from .workflows.build_space import BuildSpaceConfig
    from .workflows.check import CheckConfig, CheckResult, check
    from .workflows.collect import CollectConfig, CollectResult, collect
    from .workflows.evaluate import EvaluateConfig, EvaluateResult, evaluate
    from .workflows.export_world import export_world
    from .workflows.generate_place import generate_place
    from .workflows.learn import LearnConfig, LearnResult, learn
    from .workflows.lift_space import LiftSpaceConfig
    from .workflows.opening import ControlsConfig, EnvironmentConfig
    from .workflows.place_job import PlaceJob, PlaceStatus, place_status, resume_place, start_place
    from .workflows.plan import plan
    from .workflows.plan_result import PlanResult
    from .workflows.plan_study import PlanConfig
    from .workflows.practise import PractiseConfig, PractiseResult, practise
    from .workflows.score import ScoreConfig, ScoreResult, score
    from .workflows.train import TrainResult, adapt, train_latent, train_video
    from .workflows.train_policy import TrainPolicyConfig, TrainPolicyResult, train_policy
    from .workflows.transfer import TransferConfig, TransferResult, transfer
    from .workflows.verified_practice import VerifiedPracticeConfig, VerifiedPracticeResult, practise_by_rule

_NAMES = {
    ".act.planning": ("SearchConfig",),
    ".core": ("Spec", "State", "World", "check_world", "make_rng", "rollout"),
    ".core.env": ("as_env",),
    ".learn.recipes.adapt": ("AdaptConfig",),
    ".learn.recipes.latent": ("LatentTraining",),
    ".learn.recipes.policy": ("Practice",),
    ".learn.recipes.video": ("TrainConfig",),
    ".library": ("as_sb3", "load", "load_policy", "worlds"),
    ".workflows.build_space": ("BuildSpaceConfig",),
    ".workflows.check": ("CheckConfig", "CheckResult", "check"),
    ".workflows.collect": ("CollectConfig", "CollectResult", "collect"),
    ".workflows.evaluate": ("EvaluateConfig", "EvaluateResult", "evaluate"),
    ".workflows.export_world": ("export_world",),
    ".workflows.generate_place": ("generate_place",),
    ".workflows.learn": ("LearnConfig", "LearnResult"),
    ".workflows.lift_space": ("LiftSpaceConfig",),
    ".workflows.opening": ("ControlsConfig", "EnvironmentConfig"),
    ".workflows.place_job": ("PlaceJob", "PlaceStatus", "place_status", "resume_place", "start_place"),
    ".workflows.plan": ("plan",),
    ".workflows.plan_result": ("PlanResult",),
    ".workflows.plan_study": ("PlanConfig",),
    ".workflows.practise": ("PractiseConfig", "PractiseResult", "practise"),
    ".workflows.score": ("ScoreConfig", "ScoreResult", "score"),
    ".workflows.train": ("TrainResult", "adapt", "train_latent", "train_video"),
    ".workflows.train_policy": ("TrainPolicyConfig", "TrainPolicyResult", "train_policy"),
    ".workflows.transfer": ("TransferConfig", "TransferResult", "transfer"),
    ".workflows.verified_practice": ("VerifiedPracticeConfig", "VerifiedPracticeResult", "practise_by_rule"),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}
__all__ = [*_HOME, "__version__", "learn"]  # pyright: ignore[reportUnsupportedDunderAll]


class _LearnRoom(ModuleType):
    """The room `terrella.learn`, which is called as the workflow of the same name: `terrella.learn("gym:CarRacing-v3")`."""

    def __call__(self, *arguments: Any, **named: Any) -> LearnResult:
        return import_module(".workflows.learn", __name__).learn(*arguments, **named)


class _Package(ModuleType):
    def __setattr__(self, name: str, value: Any) -> None:  # as importing a room sets it
        if name == "learn" and isinstance(value, ModuleType):
            value.__class__ = _LearnRoom
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str):
    if name == "learn":
        return import_module(".learn", __name__)
    if name not in _HOME:
        raise AttributeError(f"module 'terrella' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_HOME[name], __name__), name)
    return value


def __dir__() -> list[str]:
    return list(__all__)
