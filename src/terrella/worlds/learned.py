"""LearnedWorld: the world that is learned from recordings, made of parts.

Each part (parts.py) owns its channels, its entries of the State and its settings. A frame is drawn when it is first read: a
rollout that asks only for what the body decides never draws.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, final

import torch
from torch import nn

from ..core import chance
from ..core.backend import constant, derived, kernels_do
from ..core.deferred import Deferred, Step
from ..core.errors import ContractError
from ..core.spec import Camera, Spec
from ..core.state import State
from ..space.estimator import Estimator
from ..space.keyframes import Keyframes
from .body import NoBody
from .config import VideoConfig
from .controls import Controls
from .frame_history import StartClips
from .generator import Conditioning, channels_last, decode
from .localisation import NoEstimator
from .objects import NoObjects
from .outcome import ConstantConfig, ConstantOutcome
from .parts import NOISE, Body, Evidence, Generator, Objects, Outcome, Scene, Uncertainty, newest_frame
from .uncertainty import GONE, Expected, NoUncertainty, drift

PATIENCE = 4096  # steps after which a frame is drawn though nobody reads it: what it waits for is kept in memory


@dataclass(frozen=True)
class About:
    """What a world is called and how it is played: fields of Spec."""

    name: str
    controls: Controls
    dt_s: float
    action_names: tuple[str, ...] = ()
    keys: Mapping[str, list[float]] = field(default_factory=dict)
    card: Mapping[str, object] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()  # channels of the recording that were not learned
    idle: tuple[float, ...] = ()
    max_episode_steps: int | None = None
    # of frames without a scene in space, where they are known
    cameras: Mapping[str, Camera] = field(default_factory=dict)


@final
class LearnedWorld:
    """Its parts never change: `replaced` gives another world. They are put into evaluation mode, without gradients to their
    weights: hand in copies of those that go on training."""

    def __init__(
        self,
        about: About,
        *,
        scene: Scene,
        generator: Generator,
        body: Body | None = None,
        objects: Objects | None = None,
        outcome: Outcome | None = None,
        uncertainty: Uncertainty | None = None,
        estimator: Estimator | NoEstimator | None = None,
    ):
        self.about, self.controls, self.scene = about, about.controls, scene
        self.generator: Any = channels_last(_finished(generator))
        self.body: Body = body or NoBody()
        self.objects: Objects = _finished(objects or NoObjects())
        self.outcome: Outcome = _finished(outcome or ConstantOutcome(ConstantConfig()))
        self.uncertainty: Uncertainty = _finished(uncertainty or NoUncertainty())
        self.estimator: Any = _finished(estimator or NoEstimator())
        self.history = max(self.body.history, scene.history)
        # in place of `advance`: fast.py
        self.stepper: Callable[[State, torch.Tensor, torch.Tensor], State] | None = None
        self.size = scene.config.size
        self._drawn_names = (*scene.drawn_names, *Expected._fields)
        self.spec = self._spec()

    # -- what it is ---------------------------------------------------------------------------------------------------

    @property
    def parts(self) -> dict[str, Any]:
        """By their names in world.json."""
        names = ("body", "scene", "generator", "objects", "outcome", "uncertainty", "estimator")
        return {name: getattr(self, name) for name in names}

    @property
    def device(self) -> torch.device:
        return self.scene.device

    @property
    def memory(self) -> Keyframes:
        """The recordings' keyframes."""
        return self.scene.recorded

    @property
    def cameras(self) -> tuple[str, ...]:
        """The picture channels that lie side by side in its frames, from the left."""
        return tuple(getattr(self.scene.config, "cameras", ())) or ("rgb",)

    @property
    def starts(self) -> Keyframes | StartClips:
        """Where episodes begin."""
        return self.scene.starts

    @cached_property
    def config(self) -> VideoConfig:
        """The settings of all parts in one."""
        drawn, posed = self.generator.config, self.scene.camera is not None
        settings: dict[str, Any] = {"camera": (1.0, 1.0, 0.5, 0.5), **vars(self.scene.config)}
        for name in ("moves", "recalls"):  # found in the recording
            settings.pop(name, None)
        settings |= {"channels": drawn.channels, "steps": drawn.steps, "residual": getattr(drawn, "residual", False)}
        if self.body:
            settings |= {name: getattr(self.body.config, name) for name in ("history", "body_m", "short")}
        settings |= {"vitals": self.outcome.begins, "actions": self.controls.numbers}
        return VideoConfig(**settings, geometry=posed, objects=bool(self.objects))

    def replaced(
        self, *, steps: int | None = None, card: Mapping[str, object] | None = None, **parts: Any
    ) -> LearnedWorld:
        """The same world with other parts; None takes a part out. steps: flow-matching steps a frame; card: facts to add to its
        card, or with None to take from it."""
        facts = {**self.about.card, **(card or {})}
        about = replace(self.about, card={name: fact for name, fact in facts.items() if fact is not None})
        if unknown := set(parts) - set(self.parts):
            raise ContractError(
                f"a learned world has no part {', '.join(sorted(unknown))}; it has {', '.join(self.parts)}."
            )
        whole = {**self.parts, **parts}
        if steps is not None:
            whole["generator"] = copy.deepcopy(whole["generator"])
            whole["generator"].config = replace(whole["generator"].config, steps=steps)
        return LearnedWorld(about, **whole)

    def to(self, device: torch.device | str) -> LearnedWorld:
        """The same world on another device: its networks, its memory and its geometry."""
        parts: dict[str, Any] = {
            name: (copy.deepcopy(part) if isinstance(part, nn.Module) else part).to(device)
            for name, part in self.parts.items()
        }
        return LearnedWorld(self.about, **parts)

    def with_memory(self, memory: Keyframes) -> LearnedWorld:
        """The same world with other keyframes of recordings."""
        return self.replaced(scene=self.scene.with_memory(recorded=memory))

    def without_memory(self) -> LearnedWorld:
        """The same world without keyframes of recordings; where episodes begin stays."""
        return self.with_memory(self.memory.at(slice(0, 0)))

    def with_memory_budget(self, budget_mb: float) -> LearnedWorld:
        """The same world with another budget in MiB for an episode's own memory; with 0 it holds the last frame alone."""
        return self.replaced(scene=self.scene.with_memory(budget_mb=budget_mb))

    def _spec(self) -> Spec:
        about, scene = self.about, self.scene
        parts = [
            scene.channels(), self.body.channels(), self.objects.channels(self.size), self.outcome.channels(),
            self.uncertainty.channels(),
        ]  # fmt: skip
        card: dict[str, object] = {"kind": "learned", **about.card}
        if about.ignored:
            card["ignored channels"] = ", ".join(about.ignored)
        return Spec(
            name=about.name,
            action=about.controls.space(),
            channels={name: space for part in parts for name, space in part.shows.items()},
            observes=tuple(name for part in parts for name in part.observes),
            dt_s=about.dt_s,
            units={name: unit for part in parts for name, unit in part.units.items()},
            action_names=tuple(about.action_names),
            keys=about.keys,
            idle=about.idle,
            max_episode_steps=about.max_episode_steps,
            cameras={"rgb": Camera(scene.camera, self.size)} if scene.camera else about.cameras,
            action_units=about.controls.units,
            action_mode=about.controls.mode,
            action_frame=about.controls.frame,
            card=card,
            may_observe=tuple(name for part in parts for name in part.may_observe),
        )

    # -- the verbs ----------------------------------------------------------------------------------------------------

    def start(self, batch: int, rng: torch.Generator) -> State:
        """Begins where one of the recordings was, standing still."""
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        seeds = chance.seeds(batch, rng, self.device)
        evidence, pick = self.scene.start(seeds)
        state = self._observed(evidence, {}, None)
        objects = self.objects.start(pick, state)
        if not objects:
            return state
        state = state.replace(**objects)  # they are no part of the recorded picture, which is drawn again
        state = self._earlier(state, state)
        state = self._draw(state, state, seeds, torch.zeros_like(state["done"]))
        return self._earlier(state, state)

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """Evidence into state, as the scene takes it (keyframe_scene.py, frame_history.py); of a pose alone the frame is drawn."""
        prior = None if prior is None else self.scene.adopt(prior)
        evidence = self.scene.evidence(observation, prior, self.estimator)
        seeds = chance.seeds(evidence.batch, rng, self.device)
        state = self._observed(evidence, observation, prior)
        if not evidence.seen:
            assert prior is not None
            objects = self.objects.step(prior, state, chance.uniforms(seeds, self.objects.draws))
            state = state.replace(**objects, gone=drift(prior, state, led=True))
            return self._draw(state, prior, seeds, torch.zeros_like(state["done"]))
        return state if evidence.lone is None else self._judged(state, evidence.lone, seeds)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step: move, then draw what is seen from there, now or when it is first read. Episodes that are over stand still."""
        numbers = self.controls.encode(self.spec.check_action(action, state.batch).to(self.device))
        seeds = chance.seeds(state.batch, rng, self.device)
        return (self.stepper or self.advance)(self.scene.adopt(state), numbers, seeds)

    def advance(self, state: State, numbers: torch.Tensor, seeds: torch.Tensor) -> State:
        """The part of `imagine` that is tensors alone: by actions [B, A] of `controls.encode` and seeds int64 [B]."""
        state, after = self.move(state, numbers)
        still, arrived = state["done"], after
        chances = chance.uniforms(seeds, {**self.objects.draws, **self.outcome.draws})
        after = after.replace(**self.objects.step(state, after, chances), gone=drift(state, after, led=False))
        after = self._draw(after, state, seeds, still)
        after = after.replace(
            **self.outcome.step(state, after, lambda: self.body.ends(arrived, numbers), numbers, chances)
        )
        others = [name for name in after if name not in (*self._drawn_names, "reward")]
        kept = _where(still, state, after, [name for name in others if after[name] is not state[name]])
        nothing = constant(torch.tensor, self.device, 0.0)
        return after.replace(**kept, reward=torch.where(still, nothing, after["reward"]))

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        state = self.scene.adopt(state)
        shown = self.scene.render(state, channels)
        shown |= self.objects.render(state, channels) | self.outcome.render(state, channels)
        return {name: shown[name] if name in shown else state[name] for name in channels}

    # -- a step in pieces, as training takes it -----------------------------------------------------------------------

    def move(self, state: State, numbers: torch.Tensor, pose: torch.Tensor | None = None) -> tuple[State, State]:
        """The state, and the state one step on, whose frame is not yet drawn: after an action [B, A] of `controls.encode`, or at
        `pose` [B, 7]. In the first those frames are drawn that the walls of the step are read from."""
        acts = torch.cat([state["actions"], numbers[:, None]], 1)
        after = {"actions": acts[:, 1:]}
        if pose is not None:
            return state, state.replace(**after, pose=pose)
        state, walls = self.scene.walls(state)
        walls = self.objects.add_walls(walls, state, self.body.half_m)
        after |= self.body.step(state, acts, walls, derived(_places, self.scene.recorded.pose))
        return state, state.replace(**after)

    def look(self, after: State, before: State) -> Conditioning:
        """What the generator draws the frame of `after` from, `before` having the last frame."""
        return self.generator.prepare(self.scene.look(after, before))

    def take(self, after: State, before: State, conditioning: Conditioning, clean: torch.Tensor) -> State:
        """`after` with the frame `clean` [B, 4 or 5, H, W] that was drawn from the conditioning, remembered if new."""
        camera = self.scene.camera
        frame = self.objects.paint(after, decode(clean, posed=camera is not None), camera)
        return self.scene.take(self._earlier(after, before), conditioning, frame)

    # -- inside -------------------------------------------------------------------------------------------------------

    def _observed(self, evidence: Evidence, observation: Mapping[str, torch.Tensor], prior: State | None) -> State:
        """The state that follows from evidence, of new episodes where there is no prior."""
        known = self.body.observe(prior, evidence) | self.outcome.observe(prior, evidence, observation)
        if not evidence.seen:
            assert prior is not None
            return prior.replace(**known)
        batch, device = evidence.batch, self.device
        known |= self.objects.observe(prior, evidence, observation, self.scene.camera)
        known["gone"] = torch.zeros(batch, len(GONE), device=device)
        known |= {name: torch.zeros(batch, device=device) for name in Expected._fields}
        if "actions" in evidence.seen:
            known["actions"] = evidence.seen["actions"]
        elif prior is None:
            known["actions"] = torch.zeros(batch, self.history, self.controls.numbers, device=device)
        state = self.scene.observe(prior, evidence).replace(**known)
        return self._earlier(state, state) if prior is None else state

    def _earlier(self, state: State, before: State) -> State:
        """The state with what its scene has to know of the frame of `before`."""
        names = self.scene.earlier_names
        return state.replace(**{f"earlier_{name}": before[name] for name in names}) if names else state

    def _draw(self, after: State, before: State, seeds: torch.Tensor, still: torch.Tensor) -> State:
        """`after` with its frame, which is drawn when it is first read; entries that are `still` [B] keep that of `before`."""
        now = {name: after[name] for name in after if name not in self._drawn_names}
        drawn = Deferred(self._drawn_names, Step(self._frame, before, {**now, "seeds": seeds, "still": still}))
        if drawn.length > PATIENCE:
            drawn.values()
        return State(now, after.arenas, drawn)

    def _frame(self, before: State, now: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The state entries that follow from drawing the frame of the state that `before` and `now` make."""
        after = before.replace(**{name: tensor for name, tensor in now.items() if name not in ("seeds", "still")})
        conditioning = self.look(after, before)
        clean = self._generated(conditioning, now["seeds"])
        expected = self.uncertainty.expected(conditioning, clean, after["gone"])
        drawn = self.take(after, before, conditioning, clean).replace(**expected._asdict())
        return _where(now["still"], before, drawn, self._drawn_names)

    def _generated(self, conditioning: Conditioning, seeds: torch.Tensor) -> torch.Tensor:
        noise = chance.normal(seeds, (4, *self.size), stream=NOISE)
        return self.generator.draw(noise, conditioning)

    def _judged(self, state: State, lone: torch.Tensor, seeds: torch.Tensor) -> State:
        """`state`, of pictures that came alone, with the error to expect, judged by what the world would draw there; `lone` [B]:
        those of a place outside the recordings."""
        strange = (10 * (self.estimator.strangeness(newest_frame(state)) - 0.95)).clamp(0, 1) * lone
        nothing = torch.zeros(state.batch, 3, device=self.device)
        state = state.replace(gone=torch.cat([nothing, lone[:, None].float(), strange[:, None]], 1))
        conditioning = self.look(state, state)
        expected = self.uncertainty.expected(conditioning, self._generated(conditioning, seeds), state["gone"])
        return state.replace(**expected._asdict())


def _places(pose: torch.Tensor) -> torch.Tensor:
    """Of poses [K, 7]: [K, 3]. Made once, so that what is derived of it is, too."""
    return pose[:, :3].contiguous()


def _finished(part: Any) -> Any:
    """A network in evaluation mode, without gradients to its weights; any other part as it is."""
    return part.eval().requires_grad_(False) if isinstance(part, nn.Module) else part


def _where(which: torch.Tensor, one: State, other: State, names: Sequence[str]) -> dict[str, torch.Tensor]:
    """The entries `names`: of `one` where `which` [B], of `other` elsewhere."""
    if kernels_do(which) and not which.any():
        return {name: other[name] for name in names}
    values = {}
    for kind in dict.fromkeys(other[name].dtype for name in names):  # those of a type at once
        mine = [name for name in names if other[name].dtype == kind]
        shapes = [other[name].shape for name in mine]
        if len(mine) < 4:
            flags = (which.view(-1, *[1] * (len(shape) - 1)) for shape in shapes)
            values |= {name: torch.where(flag, one[name], other[name]) for name, flag in zip(mine, flags)}
            continue
        counts = [shape[1:].numel() for shape in shapes]
        both = [
            torch.cat([state[name].reshape(len(which), count) for name, count in zip(mine, counts)], 1)
            for state in (one, other)
        ]
        parts = torch.where(which[:, None], *both).split(counts, 1)
        values |= {name: part.view(shape) for name, part, shape in zip(mine, parts, shapes)}
    return values
