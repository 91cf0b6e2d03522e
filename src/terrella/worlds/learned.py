"""LearnedWorld: the world that is learned from recordings, made of parts.

A body moves the viewer, a scene knows what is seen from there, a generator draws it, objects stand in it, an outcome says what
it brings, an uncertainty how wrong the frame may be, and an estimator sees depth in lone pictures. Each part owns its channels,
its tensors of the State and its settings; one that a world lacks is a null object. A frame is drawn when somebody looks: a
rollout that asks for what the body alone decides never draws.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, final

import torch
from torch import nn

from ..core import chance
from ..core.deferred import Deferred, Step
from ..core.errors import ContractError
from ..core.spec import Camera, Spec
from ..core.state import State
from ..space.estimator import Estimator
from ..space.keyframes import Keyframes
from .body import MotionBody, NoBody
from .config import VideoConfig
from .controls import Controls
from .frame_history import FrameHistory, StartClips
from .generator import Conditioning, channels_last, generate
from .keyframe_scene import KeyframeScene
from .localisation import NoEstimator
from .objects import Billboards, NoObjects
from .outcome import ConstantConfig, ConstantOutcome, FrameOutcome
from .parts import NOISE, Evidence
from .uncertainty import GONE, NoUncertainty, UncertaintyNetwork, UncertaintyProbe, gone_on

PATIENCE = 4096  # steps after which a frame is drawn though nobody looks: what waits is kept in memory


@dataclass(frozen=True)
class About:
    """What a world is called and how it is played: the fields of Spec of these names; ignored: channels of the recording that
    were not learned."""

    name: str
    controls: Controls
    dt_s: float
    action_names: tuple[str, ...] = ()
    keys: Mapping[str, list[float]] = field(default_factory=dict)
    card: Mapping[str, object] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()
    idle: tuple[float, ...] = ()
    max_episode_steps: int | None = None


@final
class LearnedWorld:
    """Its parts are read, never changed: `replaced` gives another world. They are put into evaluation mode, without gradients
    to their weights: whoever trains on hands in copies."""

    def __init__(
        self,
        about: About,
        *,
        scene: KeyframeScene | FrameHistory,
        generator: nn.Module,
        body: MotionBody | NoBody | None = None,
        objects: Billboards | NoObjects | None = None,
        outcome: FrameOutcome | ConstantOutcome | None = None,
        uncertainty: UncertaintyNetwork | UncertaintyProbe | NoUncertainty | None = None,
        estimator: Estimator | NoEstimator | None = None,
    ):
        self.about, self.controls, self.scene = about, about.controls, scene
        self.generator = channels_last(_finished(generator))
        self.body = body or NoBody()
        self.objects = _finished(objects or NoObjects())
        self.outcome = _finished(outcome or ConstantOutcome(ConstantConfig()))
        self.uncertainty = _finished(uncertainty or NoUncertainty())
        self.estimator = _finished(estimator or NoEstimator())
        self.history = max(self.body.history, scene.history)
        self.size = scene.config.size
        self._drawn_names = (*scene.drawn_names, "uncertainty")
        self.spec = self._spec()

    # -- what it is ---------------------------------------------------------------------------------------------------

    @property
    def parts(self) -> dict[str, Any]:
        """By name, as they are saved."""
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
    def starts(self) -> Keyframes | StartClips:
        """Where episodes begin."""
        return self.scene.starts

    @cached_property
    def config(self) -> VideoConfig:
        """The settings of all parts in one."""
        drawn, posed = self.generator.config, self.scene.posed
        settings: dict[str, Any] = {"camera": (1.0, 1.0, 0.5, 0.5), **vars(self.scene.config)}
        settings.pop("moves", None)  # those of a codec, found in its recording
        settings |= {name: getattr(drawn, name) for name in ("channels", "steps", "residual")}
        settings |= (
            {} if not self.body else {name: getattr(self.body.config, name) for name in ("history", "body_m", "short")}
        )
        settings |= {"vitals": self.outcome.begins, "actions": self.controls.numbers}
        return VideoConfig(**settings, geometry=posed, objects=bool(self.objects))

    def replaced(
        self, *, steps: int | None = None, card: Mapping[str, object] | None = None, **parts: Any
    ) -> LearnedWorld:
        """The same world with other parts; a part that is None is taken out. steps: in which it draws a frame; card: facts that
        are added to its card, or with None taken from it."""
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
        moved: dict[str, Any] = {
            name: copy.deepcopy(part) if isinstance(part, nn.Module) else part for name, part in self.parts.items()
        }
        return LearnedWorld(self.about, **{name: part.to(device) for name, part in moved.items()})

    def with_memory(self, memory: Keyframes) -> LearnedWorld:
        """The same world with other keyframes of recordings."""
        return self.replaced(scene=self.scene.with_memory(memory))

    def without_memory(self) -> LearnedWorld:
        """The same world, with nothing of its recordings but where they began."""
        return self.with_memory(self.memory.at(slice(0, 0)))

    def with_memory_of(self, budget_mb: float) -> LearnedWorld:
        """The same world with another budget for an episode's own memory; with 0 it holds the last frame alone."""
        return self.replaced(scene=self.scene.with_memory_of(budget_mb))

    def _spec(self) -> Spec:
        about, scene = self.about, self.scene
        said = [
            scene.channels(), self.body.channels(), self.objects.channels(self.size), self.outcome.channels(),
            self.uncertainty.channels(),
        ]  # fmt: skip
        card = dict(about.card)
        if about.ignored:
            card["ignored channels"] = ", ".join(about.ignored)
        return Spec(
            name=about.name,
            action=about.controls.space(),
            channels={name: space for part in said for name, space in part.shows.items()},
            observes=tuple(name for part in said for name in part.observes),
            dt_s=about.dt_s,
            units={name: unit for part in said for name, unit in part.units.items()},
            action_names=tuple(about.action_names),
            keys=about.keys,
            idle=about.idle,
            max_episode_steps=about.max_episode_steps,
            cameras={"rgb": Camera(scene.camera, self.size)} if scene.camera else {},
            action_units=about.controls.units,
            action_mode=about.controls.mode,
            action_frame=about.controls.frame,
            card=card,
            may_observe=tuple(name for part in said for name in part.may_observe),
        )

    # -- the verbs ----------------------------------------------------------------------------------------------------

    def start(self, batch: int, rng: torch.Generator) -> State:
        """Begins where one of the recordings was, standing still."""
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        seeds = chance.seeds(batch, rng, self.device)
        evidence, pick = self.scene.begin(seeds)
        state = self._observed(evidence, {}, None)

        def draw(bare: State) -> State:
            bare = self.scene.aged(bare, bare)
            drawn = self._draw(bare, bare, seeds, torch.zeros_like(bare["done"]))
            return self.scene.aged(drawn, drawn)

        return self.objects.begin(state, pick, draw)

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """Evidence into state, as the scene takes it (keyframe_scene.py, frame_history.py); of a pose alone the frame is dreamt."""
        prior = None if prior is None else self.scene.adopted(prior)
        evidence = self.scene.evidence(observation, prior, self.estimator)
        seeds = chance.seeds(evidence.batch, rng, self.device)
        state = self._observed(evidence, observation, prior)
        if not evidence.seen:
            assert prior is not None
            state = state.replace(**self.objects.moved(prior, state, seeds), gone=gone_on(prior, state, led=True))
            return self._draw(state, prior, seeds, torch.zeros_like(state["done"]))
        return state if evidence.lone is None else self._judged(state, evidence.lone, seeds)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step: move, then draw what is seen from there, now or when somebody looks. What is over stands still."""
        numbers = self.controls.encode(self.spec.check_action(action, state.batch).to(self.device))
        state, seeds = self.scene.settled(self.scene.adopted(state)), chance.seeds(state.batch, rng, self.device)
        still = state["done"]
        asked = self.asked(state, numbers)
        asked = asked.replace(**self.outcome.placed(state, self.body.ends(asked, numbers)))
        asked = asked.replace(**self.objects.moved(state, asked, seeds), gone=gone_on(state, asked, led=False))
        drawn = self._draw(asked, state, seeds, still)
        after = self.outcome.followed(state, drawn, self.scene.frame, numbers, seeds)
        at_hand = [name for name in after if name not in self._drawn_names and after[name] is not state[name]]
        kept = {name: _where(still, state[name], after[name]) for name in at_hand}
        return after.replace(**{**kept, "reward": torch.where(still, 0.0, after["reward"])})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        state = self.scene.adopted(state)
        show = {**self.scene.show(state), **self.objects.show(state), **self.outcome.show(state)}
        return {name: show[name]() if name in show else state[name] for name in channels}

    # -- a step in pieces, as training takes it -----------------------------------------------------------------------

    def asked(self, state: State, numbers: torch.Tensor, pose: torch.Tensor | None = None) -> State:
        """The state one step on, its frame not yet drawn: after an action [B, A] as `controls.encode` gives it, where the body
        goes by itself, or at `pose` [B, 7]."""
        acts = torch.cat([state["actions"], numbers[:, None]], 1)
        asked = state.replace(actions=acts[:, 1:])
        if pose is not None:
            return asked.replace(pose=pose)
        scene, body = self.scene, self.body
        if not body:
            return asked
        walls = self.objects.among(scene.walls(state), state, body.config.body_m)
        return asked.replace(**body.step(state, acts, walls, scene.recorded.pose[:, :3]))

    def conditioning(self, asked: State, before: State) -> Conditioning:
        """What the generator gets to draw the frame of `asked`, `before` being the last."""
        found = self.scene.conditioning(asked, before)
        return found if found.mosaic is None else replace(found, scroll=self.generator.scroll(found))

    def drawn(self, asked: State, before: State, conditioning: Conditioning, clean: torch.Tensor) -> State:
        """`asked` with the frame `clean` [B, 4 or 5, H, W] that was drawn of it, remembered if new."""

        def paint(state: State) -> State:
            return self.objects.painted(state, self.scene.camera)

        return self.scene.drawn(self.scene.aged(asked, before), conditioning, clean, paint)

    # -- inside -------------------------------------------------------------------------------------------------------

    def _observed(self, evidence: Evidence, observation: Mapping[str, torch.Tensor], prior: State | None) -> State:
        begins = prior is None
        prior = self._blank(evidence) if prior is None else prior
        body, outcome = self.body.observed(prior, evidence.pose), self.outcome.observed(prior, evidence, observation)
        state = prior.replace(
            **body, **outcome, gone=torch.zeros_like(prior["gone"]) if evidence.seen else prior["gone"]
        )
        if not evidence.seen:
            return state
        state = self.scene.pictured(state, evidence)
        state = state.replace(**self.objects.observed(state, observation, self.scene.camera))
        state = state.replace(uncertainty=torch.zeros_like(state["reward"]))
        return self.scene.kept(state, begins)

    def _blank(self, evidence: Evidence) -> State:
        batch, there = evidence.batch, self.device
        state = self.scene.blank(evidence)
        return state.replace(
            **self.body.blank(batch, evidence.pose), **self.outcome.blank(batch, there), **self.objects.blank(batch),
            actions=torch.zeros(batch, self.history, self.controls.numbers, device=there),
            gone=torch.zeros(batch, len(GONE), device=there), uncertainty=torch.zeros(batch, device=there),
        )  # fmt: skip

    def _draw(self, asked: State, before: State, seeds: torch.Tensor, still: torch.Tensor) -> State:
        """`asked` with its frame, which is drawn when it is first read; entries that are `still` [B] keep that of `before`."""
        now = {name: asked[name] for name in asked if name not in self._drawn_names}
        frame = Step(self._frame, before, {**now, "seeds": seeds, "still": still})
        drawn = Deferred(self._drawn_names, frame)
        if drawn.length > PATIENCE:
            drawn.values()
        return State(now, asked.arenas, drawn)

    def _frame(self, before: State, now: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The tensors that follow from drawing the frame of the state that `before` and `now` make."""
        asked = before.replace(**{name: tensor for name, tensor in now.items() if name not in ("seeds", "still")})
        conditioning = self.conditioning(asked, before)
        clean = self._generated(conditioning, now["seeds"])
        expected = self._expected(asked, conditioning, clean)
        after = self.drawn(asked, before, conditioning, clean).replace(uncertainty=expected)
        return {name: _where(now["still"], before[name], after[name]) for name in self._drawn_names}

    def _generated(self, conditioning: Conditioning, seeds: torch.Tensor) -> torch.Tensor:
        noise = chance.normal(seeds, (4, *self.size), stream=NOISE)
        return generate(self.generator, noise, conditioning, self.generator.config.steps)

    def _expected(self, state: State, conditioning: Conditioning, clean: torch.Tensor) -> torch.Tensor:
        """The error [B] to expect of a frame `clean` that was drawn for `state`."""
        gone = state["gone"]
        situation = torch.cat([gone[:, :4].clamp_max(128).log1p(), self.scene.familiar(state)], 1)
        return self.uncertainty.expected(conditioning, clean, situation, gone[:, 4])

    def _judged(self, state: State, lone: torch.Tensor, seeds: torch.Tensor) -> State:
        """`state`, of lone pictures, with the error to expect: what the world itself would draw of them says it. Those that are
        `lone` [B] are of elsewhere."""
        strange = (10 * (self.estimator.strangeness(self.scene.frame(state)) - 0.95)).clamp(0, 1) * lone
        nothing = torch.zeros(state.batch, 3, device=self.device)
        state = state.replace(gone=torch.cat([nothing, lone[:, None].float(), strange[:, None]], 1))
        conditioning = self.conditioning(state, state)
        return state.replace(uncertainty=self._expected(state, conditioning, self._generated(conditioning, seeds)))


def _finished(part: Any) -> Any:
    """A network in evaluation mode, without gradients to its weights; any other part as it is."""
    return part.eval().requires_grad_(False) if isinstance(part, nn.Module) else part


def _where(which: torch.Tensor, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Entries of `one` [B, ...] where `which` [B], of `other` elsewhere."""
    return torch.where(which.view(-1, *[1] * (one.ndim - 1)), one, other)
