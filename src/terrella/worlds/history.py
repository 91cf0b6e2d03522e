"""HistoryWorld: the generator of worlds/video.py on history alone, for recordings without depth or pose.

The last frames take the place of keyframes, unwarped, and the actions are told to the network, since no motion model
turns them into a view. Reward, end and vitals are read off the frames by an Outcome (worlds/outcome.py), where the
recording had any. It answers and stays in tune with its recordings; it does not remember what left the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ..core.errors import ContractError, ObservationError
from ..core.spec import Spec
from ..core.state import State
from ..space.estimator import Estimator
from ..space.keyframes import Glimpse
from .controls import Controls
from .generator import Generator, VideoConfig, channels_last, context_thumbnail, generate
from .outcome import Outcome, told_vitals
from .uncertainty import SITUATION, Uncertainty, uncertain_spec

TRUST = 0.03  # in a frame, against the one after it: what is merged from all of them is nearly the newest alone


@dataclass(frozen=True)
class Starts:
    """Where stories begin, S pieces of recording, the newest first: frames uint8 [S, slots, 3, H, W]; the actions that
    led to them as told to networks [S, slots, A]; vitals [S, V]."""

    frames: torch.Tensor
    actions: torch.Tensor
    vitals: torch.Tensor

    @staticmethod
    def of(frames: torch.Tensor, actions: int) -> Starts:
        """No button held, and no vitals."""
        return Starts(frames, torch.zeros(*frames.shape[:2], actions), torch.zeros(len(frames), 0))


class HistoryWorld:
    """`starts`: where stories begin; `reward`: the usual one, of a world without an `outcome`; `controls`: what actions
    mean, by default a button for each number of one."""

    def __init__(
        self,
        spec: Spec,
        config: VideoConfig,
        generator: Generator,
        starts: Starts,
        reward: float = 0.0,
        outcome: Outcome | None = None,
        controls: Controls | None = None,
        uncertainty: Uncertainty | None = None,
    ):
        self.spec, self.config = uncertain_spec(spec, uncertainty is not None), config
        self.starts, self.reward, self.uncertainty = starts, reward, uncertainty
        self.generator = channels_last(generator.eval())
        self.outcome = outcome.eval() if outcome else None
        self.controls = controls or Controls.buttons(config.actions)

    def start(self, batch: int, rng: torch.Generator) -> State:
        """Begins with a piece of a recording."""
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        picks = torch.randint(len(self.starts.frames), (batch,), generator=rng)
        return self._begun(*(part[picks] for part in vars(self.starts).values()))

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """A picture replaces the newest frame of the prior, and vitals, where they are given, its vitals; without a prior
        it stands for the whole history."""
        height, width = self.config.size
        if "rgb" not in observation:
            raise ObservationError(f"{self.spec.name} observes rgb; got {list(observation)}.")
        rgb = torch.as_tensor(observation["rgb"])
        if rgb.ndim != 4 or rgb.shape[1:] != (height, width, 3):
            raise ObservationError(f"rgb is uint8 [B, {height}, {width}, 3]; got {tuple(rgb.shape)}.")
        if rgb.dtype != torch.uint8:
            raise ObservationError(f"rgb must be uint8, 0 to 255; got {rgb.dtype}.")
        if prior is not None and prior.batch != len(rgb):
            raise ObservationError(f"the prior holds {prior.batch} stories, the evidence tells of {len(rgb)}.")
        frame = rgb.permute(0, 3, 1, 2)[:, None]
        if prior is None:
            slots = self.config.slots
            usual = self.starts.vitals.median(0).values if self.starts.vitals.numel() else self.starts.vitals[:1]
            actions = torch.zeros(len(rgb), slots, self.config.actions)
            state = self._begun(frame.repeat(1, slots, 1, 1, 1), actions, usual.expand(len(rgb), -1))
        else:
            state = prior.replace(frames=torch.cat([frame, prior["frames"][:, 1:]], 1), **self._sure(len(rgb)))
        if self.outcome is None:
            return state
        vitals = told_vitals(self.outcome, observation, state["vitals"])
        going = {"reward": torch.zeros(len(rgb)), "done": torch.zeros(len(rgb), dtype=torch.bool)}
        return state.replace(vitals=vitals, **going)

    @torch.inference_mode()
    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step; a story that is done stands still, without reward."""
        told = self.controls.tell(self.spec.check_action(action, state.batch))[:, None]
        asked = state.replace(actions=torch.cat([told, state["actions"][:, :-1]], 1))
        noise = torch.randn(state.batch, 4, *self.config.size, generator=rng)
        there = next(self.generator.parameters()).device
        glimpse, last, mind = self.shown(asked)
        parts = noise.to(there), glimpse.to(there), last.to(there), mind.to(there)
        clean = generate(self.generator, *parts, self.config.steps).cpu()
        if self.uncertainty is not None:
            gone = asked["gone"] + 1
            said = F.pad(gone.clamp_max(128).log1p()[:, None], (0, SITUATION - 1))
            expected = self.uncertainty.expected(glimpse, last, clean, said, torch.zeros(state.batch))
            asked = asked.replace(gone=gone, uncertainty=expected)
        return self.followed(state, self.drawn(asked, clean))

    def with_senses(self, estimator: Estimator | None, uncertainty: Uncertainty | None) -> HistoryWorld:
        """The same world with another doubt, or without; it has no use for an eye."""
        del estimator
        parts = self.generator, self.starts, self.reward, self.outcome, self.controls, uncertainty
        return HistoryWorld(self.spec, self.config, *parts)

    def shown(self, state: State) -> tuple[Glimpse, torch.Tensor, torch.Tensor]:
        """What the generator gets (glimpse, last, told) to draw the frame that follows `state`'s newest action."""
        nothing = torch.zeros(state.batch, 4, *self.config.size)
        told = torch.cat([context_thumbnail(state["frames"][:, 0]), state["actions"].flatten(1)], 1)
        return past(state["frames"]), nothing, told

    def drawn(self, state: State, clean: torch.Tensor) -> State:
        """`state` with the frame `clean` [B, 4, H, W] that the generator drew as its newest."""
        frame = ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)[:, None]
        return state.replace(frames=torch.cat([frame, state["frames"][:, :-1]], 1))

    def followed(self, before: State, after: State) -> State:
        """`after`, the step from `before`, with its reward, end and vitals; what was done before stays as it was."""
        if self.outcome is None:
            return after
        frames, action = (before["frames"][:, 0], after["frames"][:, 0]), after["actions"][:, 0]
        found = self.outcome(frames[0], frames[1], action, before["vitals"], before["hidden"])
        moved = after.replace(vitals=found.vitals, hidden=found.hidden, reward=found.reward, done=found.done > 0)
        if not before["done"].any():
            return moved
        return before.replace(reward=torch.zeros_like(before["reward"])).where(before["done"], moved)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        show = {"rgb": lambda: state["frames"][:, 0].permute(0, 2, 3, 1).contiguous()}
        if self.outcome is None:
            show["reward"] = lambda: torch.full((state.batch,), self.reward)
            show["done"] = lambda: torch.zeros(state.batch, dtype=torch.bool)
        else:
            columns = {name: column for column, name in enumerate(self.outcome.config.vitals)}
            show |= {name: lambda column=column: state["vitals"][:, column].clone() for name, column in columns.items()}
        return {name: show[name]() if name in show else state[name] for name in channels}

    def _begun(self, frames: torch.Tensor, actions: torch.Tensor, vitals: torch.Tensor) -> State:
        state = State({"frames": frames, "actions": actions, **self._sure(len(frames))})
        if self.outcome is None:
            return state
        nothing, going = torch.zeros(len(frames)), torch.zeros(len(frames), dtype=torch.bool)
        hidden = self.outcome.begin(len(frames))
        return state.replace(vitals=vitals.clone(), hidden=hidden, reward=nothing, done=going)

    def _sure(self, batch: int) -> dict[str, torch.Tensor]:
        """What is written of doubt where evidence was just seen."""
        return {} if self.uncertainty is None else {"gone": torch.zeros(batch), "uncertainty": torch.zeros(batch)}


def past(frames: torch.Tensor) -> Glimpse:
    """The last frames (uint8 [B, slots, 3, H, W], the newest first) in the place of what a memory knows."""
    batch, slots, _, height, width = frames.shape
    trust = TRUST ** torch.arange(slots, dtype=torch.float32)
    everywhere = torch.ones(batch, height, width)
    return Glimpse(
        frames.float() / 255, trust[None, :, None, None].expand(batch, -1, height, width), everywhere, everywhere
    )
