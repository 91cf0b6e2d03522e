"""LatentWorld: a world that predicts latents instead of pixels, for agents that plan and practise in thousands of episodes.

An ensemble of predictors moves the latent under actions (PETS, Chua et al. 2018); its disagreement gives the error to expect.
Pictures are decoded only on request, for people (joint-embedding loss: LeWorldModel, Maes et al. 2026).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import final

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces

from ..core import chance
from ..core.errors import ContractError, ObservationError
from ..core.spec import DONE, POSE, POSE_UNIT, REWARD, Spec, kind_of
from ..core.state import State
from .controls import AXES
from .latent_network import FARTHEST, LatentNetwork, Looks
from .learned import About
from .parts import STARTS, check_prior, picture_of

FORGOTTEN = 2**20  # steps: the age of no picture
UNIT = "expected error of the latent, 0 exact to 1 no better than its mean"


@final
class LatentWorld:
    """State: window [B, K, D], the last latents, the newest last; actions [B, K - 1, A] between them; reward, done,
    done_probability; spread, the ensemble's variance summed since the last evidence; where a latent is made of F pictures also
    glances [B, F - 1, G] of the last ones, the newest first, their ages [B, F - 1] in steps (-1: none). starts: latents [N, D] with
    which episodes begin. A step is deterministic."""

    def __init__(self, about: About, network: LatentNetwork, starts: torch.Tensor):
        self.about, self.controls = about, about.controls
        self.network = network.eval().requires_grad_(False)
        self.starts = starts.to(network.mean.device)
        self.spec = self._spec()

    @property
    def device(self) -> torch.device:
        return self.starts.device

    def to(self, device: torch.device | str) -> LatentWorld:
        """The same world on another device."""
        return LatentWorld(self.about, copy.deepcopy(self.network).to(device), self.starts.to(device))

    def _spec(self) -> Spec:
        about, config = self.about, self.network.config
        free = spaces.Box(-FARTHEST, FARTHEST, (config.latent,), np.float32)
        shows: dict[str, spaces.Space] = {"latent": free}
        shows |= {"rgb": spaces.Box(0, 255, (*config.size, 3), np.uint8)} if config.size else {}
        for name, width in config.vectors:
            shape = () if _lone(name, width) else (width,)
            shows[name] = POSE if kind_of(name) == "pose" else spaces.Box(-np.inf, np.inf, shape, np.float32)
        unit = spaces.Box(0, 1, (), np.float32)
        shows |= {"reward": REWARD, "done": DONE, "done_probability": unit, "uncertainty": unit}
        poses = {name: POSE_UNIT for name in shows if kind_of(name) == "pose"}
        needed = ("rgb",) if config.pictured else config.seen
        card = {
            "kind": "latent",
            **about.card,
            **({"ignored channels": ", ".join(about.ignored)} if about.ignored else {}),
        }
        return Spec(
            name=about.name,
            action=about.controls.space(),
            channels=shows,
            observes=needed,
            may_observe=tuple(name for name in config.seen if name not in needed),
            dt_s=about.dt_s,
            units={**poses, "uncertainty": UNIT},
            action_names=tuple(about.action_names),
            action_units=about.controls.units,
            action_mode=about.controls.mode,
            action_frame=about.controls.frame,
            keys=about.keys,
            idle=about.idle,
            max_episode_steps=about.max_episode_steps,
            differentiable=about.controls.kind == AXES,
            card=card,
            leap=config.leap,
        )

    # -- the verbs ----------------------------------------------------------------------------------------------------

    def start(self, batch: int, rng: torch.Generator) -> State:
        """Begins where one of the recording's episodes did."""
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        drawn = chance.uniform(chance.seeds(batch, rng, self.device), stream=STARTS)
        return self._begun(self.starts[(drawn * len(self.starts)).long()], None)

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """The latent of the observation in place of the imagined one. Without a prior nothing is known of what came before: a
        single picture, such as a goal, has no velocity."""
        lacks = [name for name in self.spec.observes if name not in observation]
        if lacks:
            raise ObservationError(f"{self.spec.name} observes {', '.join(lacks)}, which the observation lacks.")
        look = numbers = None
        network, config = self.network, self.network.config
        if config.pictured:
            assert config.size is not None
            look = network.look(picture_of(observation, config.size, self.device))
        given = {name: self._vector(name, observation[name]) for name in config.seen if name in observation}
        batches = {len(part) for part in (look, *given.values()) if part is not None}
        if len(batches) != 1:
            raise ObservationError(
                f"the channels of an observation are of one batch; got batches of {sorted(batches)}."
            )
        if config.seen and len(given) == len(config.seen):
            blank = network.mean.expand(next(iter(batches)), -1)
            parts = blank.split([width for _, width in config.vectors], 1)
            numbers = torch.cat([given.get(name, part) for (name, _), part in zip(config.vectors, parts)], 1)
        if look is None:
            return self._begun(network.encode(None, numbers), prior)
        if prior is not None:
            check_prior(prior.batch, len(look))
        looks = self._looks(look, prior)
        state = self._begun(network.encode(looks, numbers), prior)
        if config.frames == 1:
            return state
        glances = torch.cat([network.glance(look)[:, None], looks.past[:, :-1]], 1)
        ages = torch.arange(config.frames - 1, device=self.device).expand(len(look), -1)
        seen = torch.cat([torch.ones_like(looks.known[:, :1]), looks.known[:, :-1]], 1)
        return state.replace(glances=glances, ages=torch.where(seen > 0, ages, FORGOTTEN))

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step. Episodes that are over stand still."""
        taken = self.controls.encode(self.spec.check_action(action, state.batch).to(self.device))
        return self.advance(state, taken)

    def advance(self, state: State, taken: torch.Tensor, seeds: torch.Tensor | None = None) -> State:
        """The part of `imagine` that is tensors alone, by actions [B, A] of `controls.encode`; nothing is drawn by chance."""
        network, window, still = self.network, state["window"], state["done"]
        actions = torch.cat([state["actions"], taken[:, None]], 1)
        members = network.predict(window, actions)
        latent = members.mean(0)
        outcome = network.outcome(window, taken, latent)
        after = {
            "window": torch.cat([window[:, 1:], latent[:, None]], 1),
            "actions": actions[:, 1:],
            "reward": network.expected_reward(outcome.reward),
            "done_probability": outcome.done.sigmoid(),
            "spread": state["spread"] + members.var(0, correction=0).mean(1),
        }
        if "ages" in state:
            after["ages"] = state["ages"] + 1
        held = {"reward": torch.zeros_like(state["reward"])}
        kept = {}
        for name, now in after.items():
            kept[name] = torch.where(still.view(-1, *[1] * (now.ndim - 1)), held.get(name, state[name]), now)
        return state.replace(**kept, done=still | (outcome.done > 0))

    def leap(self, state: State, actions: torch.Tensor, rng: torch.Generator) -> State:
        """`Spec.leap` steps at once, under actions [B, leap, *action.shape]. Only latents and actions change; reward, end and
        uncertainty stay. Episodes that are over stand still."""
        flat = self.spec.check_action(actions.flatten(0, 1), actions.shape[0] * actions.shape[1]).to(self.device)
        taken = self.controls.encode(flat).unflatten(0, actions.shape[:2])
        past = torch.cat([state["actions"], taken], 1)
        still = state["done"].view(-1, 1, 1)
        window = torch.where(still, state["window"], self.network.leap(state["window"], past))
        kept = past[:, past.shape[1] - state["actions"].shape[1] :]
        ages = {"ages": state["ages"] + self.spec.leap} if "ages" in state else {}
        return state.replace(window=window, actions=torch.where(still, state["actions"], kept), **ages)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        vectors = dict(self.network.config.vectors)
        numbers = self._numbers(state) if vectors.keys() & set(channels) else {}
        return {name: numbers[name] if name in vectors else self._shown(state, name) for name in channels}

    # -- inside -------------------------------------------------------------------------------------------------------

    def _looks(self, look: torch.Tensor, prior: State | None) -> Looks:
        """Of pictures with features `look` [B, hidden], and of the pictures one step before them, two, and so on."""
        config = self.network.config
        if prior is None or config.frames == 1:
            past = look.new_zeros(len(look), config.frames - 1, config.glance)
            return Looks(look, past, past[..., 0])
        steps = torch.arange(1, config.frames, device=self.device)
        match = (prior["ages"][:, None] == steps[:, None]).float()  # [B, steps, glances]
        return Looks(look, match @ prior["glances"], match.sum(2))

    def _begun(self, latent: torch.Tensor, prior: State | None) -> State:
        config, batch = self.network.config, len(latent)
        latent = latent.clamp(-FARTHEST, FARTHEST)
        if prior is None:
            window = latent[:, None].repeat(1, config.history, 1)
            actions = latent.new_zeros(batch, config.history - 1, config.actions)
        else:
            check_prior(prior.batch, batch)
            window, actions = torch.cat([prior["window"][:, :-1], latent[:, None]], 1), prior["actions"]
        nothing = latent.new_zeros(batch)
        done = torch.zeros(batch, dtype=torch.bool, device=latent.device)
        state = {
            "window": window, "actions": actions, "reward": nothing, "done": done, "done_probability": nothing,
            "spread": nothing,
        }  # fmt: skip
        if config.pictured and config.frames > 1:
            state["glances"] = latent.new_zeros(batch, config.frames - 1, config.glance)
            state["ages"] = torch.full((batch, config.frames - 1), FORGOTTEN, device=self.device)
        return State(state)

    def _vector(self, name: str, given: torch.Tensor) -> torch.Tensor:
        width = dict(self.network.config.vectors)[name]
        vector = torch.as_tensor(given).to(self.device).float()
        whole = vector[:, None] if width == 1 and vector.ndim == 1 else vector
        if whole.ndim != 2 or whole.shape[1] != width or not torch.isfinite(whole).all():
            raise ObservationError(f"{name} is finite float [B, {width}]; got {tuple(vector.shape)}.")
        return whole

    def _numbers(self, state: State) -> dict[str, torch.Tensor]:
        network = self.network
        flat = network.numbers(state["window"]) * network.scale + network.mean
        vectors = network.config.vectors
        parts = dict(zip((name for name, _ in vectors), flat.split([width for _, width in vectors], 1)))
        shown = {name: _posed(part) if kind_of(name) == "pose" else part for name, part in parts.items()}
        return {name: part[:, 0] if _lone(name, part.shape[1]) else part for name, part in shown.items()}

    def _shown(self, state: State, name: str) -> torch.Tensor:
        if name == "latent":
            return state["window"][:, -1]
        if name == "rgb":
            return self.network.decode(state["window"][:, -1])
        return self.network.expected(state["spread"]) if name == "uncertainty" else state[name]


def _lone(name: str, width: int) -> bool:
    """Whether a channel is one number, such as the player's health; recordings hold it as a list of one."""
    return width == 1 and kind_of(name) not in ("observation", "state")


def _posed(pose: torch.Tensor) -> torch.Tensor:
    """Poses [B, 7] whose quaternions have length 1."""
    turn = pose[:, 3:] + pose.new_tensor([1e-6, 0, 0, 0])
    return torch.cat([pose[:, :3], F.normalize(turn, dim=1)], 1)
