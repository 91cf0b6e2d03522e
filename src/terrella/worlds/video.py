"""VideoWorld: a first-person world learned from posed RGB-D recordings, that draws the next frame and remembers places.

State is where the eye stands, how it moves, the frame it sees, and the keyframes of its own dream; the keyframes of the
recordings travel with the world as its long-term memory. `imagine` predicts the motion that the action causes (`Motion`,
then the walls that the keyframes saw), asks memory what the new view shows (space/keyframes.py), and a generator
completes it (`Generator`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import torch
import torch.nn.functional as F

from ..core.errors import ContractError, ObservationError
from ..core.spec import Spec
from ..core.state import State
from ..space.billboards import cut_out
from ..space.camera import Intrinsics, planar_pose, yaw
from ..space.estimator import Estimator
from ..space.floorplan import NOWHERE, floor_plan, slide
from ..space.keyframes import Glimpse, Keyframes
from ..space.memory import RECORDED, Memory, keyframe_table, remembering_spec
from ..space.patches import FAR_M
from ..space.recognise import thumbnails
from ..space.reproject import carry_unknown, fill_holes
from .arrival import AWAY_M, arrive
from .generator import Generator, VideoConfig, channels_last, context_thumbnail, decode_depth, generate
from .motion import Motion
from .moving import Frame, carry_frames, covering, still
from .objects import Objects
from .outcome import Outcome, told_vitals
from .uncertainty import GONE, Uncertainty, uncertain_spec

SEEN = ("rgb", "depth", "things", "pose", "instances")  # of a frame in the state of a world in which things move


class VideoWorld:
    """The learned world; worlds/folder.py saves and loads it.

    `memory` are the recordings' keyframes (may be empty), `starts` those that a story may begin from.
    """

    def __init__(
        self, spec: Spec, config: VideoConfig, generator: Generator, motion: Motion,
        memory: Keyframes, starts: Keyframes, rewards: tuple[float, float],
        estimator: Estimator | None = None, uncertainty: Uncertainty | None = None, outcome: Outcome | None = None,
        objects: Objects | None = None,
    ):  # fmt: skip
        self.config, self.memory, self.starts, self.rewards = config, memory, starts, rewards
        self.estimator, self.uncertainty = estimator, uncertainty
        self.outcome = outcome.eval() if outcome else None
        self.objects = objects.eval() if objects else None
        self.own = own_memory(config)
        self.spec = uncertain_spec(
            remembering_spec(spec, config.size, len(memory) + self.own.capacity), uncertainty is not None
        )
        self.generator = channels_last(generator.eval())
        self.motion = motion.eval()

    @cached_property
    def _recorded(self) -> torch.Tensor:
        """The recordings' part of the channel `keyframes`."""
        return keyframe_table(self.memory.pose, torch.full((len(self.memory),), RECORDED))

    @cached_property
    def _headings(self) -> torch.Tensor:
        return yaw(self.memory.pose)

    @cached_property
    def _small(self) -> torch.Tensor:
        """By which a lone picture's place is sought."""
        return thumbnails(self.memory.rgb)

    @cached_property
    def _walls(self) -> torch.Tensor:
        return floor_plan(self.memory.walls, self.memory.pose)

    @torch.inference_mode()
    def start(self, batch: int, rng: torch.Generator) -> State:
        """Begins where one of the recordings was, standing still."""
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        pick = torch.randint(len(self.starts), (batch,), generator=rng)
        keys = self.starts.at(pick)
        rgb = F.interpolate(keys.rgb.float(), self.config.size, mode="area")
        seen = {"rgb": rgb.round().to(torch.uint8).permute(0, 2, 3, 1), "depth": keys.depth, "pose": keys.pose}
        if self.config.moving:  # of what moves, a keyframe keeps the place only
            seen |= {"things": keys.depth <= 0, "depth": fill_holes(torch.where(keys.depth > 0, keys.depth, FAR_M))}
        state = self.observe(seen, None, rng)
        if self.objects is None:
            return state
        billboards = self.objects.begun[
            pick
        ]  # in place of the things that the picture shows, which would stand there for ever
        shown = state["things"].to(torch.uint8)
        bare = state.replace(billboards=billboards, billboards_before=billboards, instances=shown)
        bare = self.aged(bare, bare)
        peopled = self._draw(bare, bare, rng)
        return self.aged(peopled, peopled)

    @torch.inference_mode()
    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """Evidence: rgb, depth and pose together become a keyframe of the state; a pose alone moves the eye there
        (it needs a prior) and the frame is dreamt; a picture alone is seen from the prior's pose, or without a prior from
        the remembered place that it shows, else from an empty corner (arrival.py). Its depth is then the eye's."""
        if set(observation) & {"rgb", "depth", "pose"} == {"rgb"} and self.estimator is not None:
            return self._arrive(observation, self.estimator, prior, rng)
        if "pose" not in observation:
            alone = ", a picture alone" if self.estimator else ""
            blind = "" if self.estimator else " For a picture alone it needs an eye: `terrella train senses`."
            raise ObservationError(
                f"{self.spec.name} observes rgb, depth and pose{alone}, or a pose alone; got {list(observation)}.{blind}"
            )
        pose = torch.as_tensor(observation["pose"]).float()
        batch = len(pose)
        if pose.shape != (batch, 7) or not torch.isfinite(pose).all():
            raise ObservationError(f"pose is finite float [B, 7] (x, y, z, quaternion wxyz); got {tuple(pose.shape)}.")
        if prior is not None and prior.batch != batch:
            raise ObservationError(f"the prior holds {prior.batch} stories, the evidence tells of {batch}.")
        begins = prior is None
        if prior is None:
            if not {"rgb", "depth"} <= set(observation):
                raise ObservationError(
                    "a pose alone says nothing of what is seen there: give rgb and depth, or a prior."
                )
            prior = self._blank(batch, pose)
        speed = pose[:, :2] - prior["pose"][:, :2]
        speed = speed + torch.where(
            prior["dreamt"][:, None], prior["speed"], 0.0
        )  # what was dreamt, and how wrong it was
        speed = torch.where((speed.norm(dim=-1) < 1.0)[:, None], speed, 0.0)
        no, nothing = torch.zeros(batch, dtype=torch.bool), torch.zeros(batch)
        state = prior.replace(pose=pose, speed=speed, dreamt=no, done=no, reward=nothing)
        if self.outcome is not None:
            state = state.replace(vitals=told_vitals(self.outcome, observation, state["vitals"]))
        if not {"rgb", "depth"} <= set(observation):
            state = self._stepped(state, prior, rng)
            return self._draw(self._gone(self.aged(state, prior), prior, None), prior, rng)
        height, width = self.config.size
        rgb, depth = torch.as_tensor(observation["rgb"]), torch.as_tensor(observation["depth"])
        if rgb.shape != (batch, height, width, 3) or depth.shape != (batch, height, width):
            raise ObservationError(f"rgb is uint8 [B, {height}, {width}, 3] and depth [B, {height}, {width}].")
        if rgb.dtype != torch.uint8 or not (torch.isfinite(depth).all() and (depth > 0).all()):
            raise ObservationError("rgb must be uint8, and depth finite and above 0 metres.")
        rgb, depth = rgb.permute(0, 3, 1, 2).contiguous(), depth.float()
        if self.config.moving:
            things = torch.as_tensor(observation.get("things", prior["things"])).float()  # else where they were dreamt
            if things.shape != depth.shape:
                raise ObservationError(f"things is bool [B, {height}, {width}]; got {tuple(things.shape)}.")
            state = state.replace(things=things)
            if self.objects is not None:
                state = state.replace(**self._recognised(self.objects, rgb, depth, pose, observation, prior))
        kept = self.own.observed(state, rgb, self._lasting(state, depth), pose)
        if self.uncertainty is not None:
            kept |= {"gone": torch.zeros(batch, len(GONE)), "uncertainty": torch.zeros(batch)}
        seen = state.replace(rgb=rgb, depth=depth, known=torch.full(depth.shape, 255, dtype=torch.uint8), **kept)
        return self.aged(seen, seen) if begins else seen  # a story that begins has stood still

    @torch.inference_mode()
    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step: move, then draw what is seen from there."""
        action = self.spec.check_action(action, state.batch).float().view(state.batch, -1)
        pose, acts = state["pose"], torch.cat([state["actions"], action[:, None]], 1)
        heading, wish = self.motion(yaw(pose), state["speed"], acts)
        moved, speed = self._walk(state, wish)
        place = pose[:, :2] + moved
        height = self._height(pose[:, :2], place, pose[:, 2]) if self.config.moving else pose[:, 2]
        pose = planar_pose(place[:, 0], place[:, 1], height, heading)
        still = state["done"]
        done = still if self.outcome else still | (self.motion.ends(place, action) > 0)
        next_state = state.replace(
            pose=torch.where(still[:, None], state["pose"], pose), speed=torch.where(still[:, None], 0.0, speed),
            actions=acts[:, 1:], dreamt=torch.ones_like(done), done=done,
            reward=torch.where(still, 0.0, self.rewards[0] + self.rewards[1] * done.float()),
        )  # fmt: skip
        next_state = self._stepped(next_state, state, rng)
        drawn = self._draw(self._gone(self.aged(next_state, state), state, moved), state, rng)
        after = drawn if self.outcome is None else self._followed(self.outcome, state, drawn, action, rng)
        if not still.any():
            return after
        return state.replace(reward=torch.zeros_like(state["reward"])).where(still, after)  # what is over stands still

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        vitals = self.outcome.config.vitals if self.outcome else ()
        show = {
            "rgb": lambda: state["rgb"].permute(0, 2, 3, 1).contiguous(),
            "known": lambda: state["known"].float() / 255,
            "things": lambda: state["things"] > 0.5,
            "objects": lambda: state["billboards"][..., :4] * _in_sight(state)[..., None],
            **{name: lambda at=at: state["vitals"][:, at].clone() for at, name in enumerate(vitals)},
            "keyframes": lambda: torch.cat([self._recorded.expand(state.batch, -1, -1), self.own.table(state)], 1),
        }
        return {name: show[name]() if name in show else state[name] for name in channels}

    def without_memory(self) -> VideoWorld:
        """The same world, with nothing of its recordings but where they began."""
        return self.with_memory(self.memory.at(slice(0, 0)))

    def with_memory(self, memory: Keyframes) -> VideoWorld:
        """The same world with other keyframes of recordings."""
        return self._with(memory=memory)

    def with_senses(self, estimator: Estimator | None, uncertainty: Uncertainty | None) -> VideoWorld:
        """The same world with another eye and another doubt, or without."""
        return self._with(estimator=estimator, uncertainty=uncertainty)

    def with_memory_of(self, budget_mb: float) -> VideoWorld:
        """The same world with another budget for a story's own memory; with 0 it holds the last frame alone."""
        return self._with(config=replace(self.config, memory_mb=budget_mb))

    def _with(self, **parts) -> VideoWorld:
        names = (
            "spec", "config", "generator", "motion", "memory", "starts", "rewards",
            "estimator", "uncertainty", "outcome", "objects",
        )  # fmt: skip
        return VideoWorld(**{name: parts.get(name, getattr(self, name)) for name in names})

    def _blank(self, batch: int, pose: torch.Tensor) -> State:
        config, (height, width) = self.config, self.config.size
        state = State(
            {
                "pose": pose, "speed": torch.zeros(batch, 2), "dreamt": torch.zeros(batch, dtype=torch.bool),
                "actions": torch.zeros(batch, config.history, config.actions),
                "reward": torch.zeros(batch), "done": torch.zeros(batch, dtype=torch.bool),
                "rgb": torch.zeros(batch, 3, height, width, dtype=torch.uint8), "depth": torch.ones(batch, height, width),
                "known": torch.zeros(batch, height, width, dtype=torch.uint8), **self.own.empty(batch),
                **({} if self.uncertainty is None else {"gone": torch.zeros(batch, len(GONE)), "uncertainty": torch.zeros(batch)}),
            },
            self.own.arenas,
        )  # fmt: skip
        if self.outcome is not None:
            vitals = torch.tensor(config.vitals).expand(batch, -1)
            state = state.replace(vitals=vitals, hidden=self.outcome.begin(batch))
        if not config.moving:
            return state
        instances = torch.zeros(batch, height, width, dtype=torch.uint8)
        state = state.replace(things=torch.zeros(batch, height, width), instances=instances)
        if self.objects is not None:
            state = state.replace(billboards=self.objects.empty(batch), billboards_before=self.objects.empty(batch))
        return self.aged(state, state)

    def _recognised(
        self, objects: Objects, rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor,
        observation: Mapping[str, torch.Tensor], prior: State,
    ) -> dict[str, torch.Tensor]:  # fmt: skip
        """The cards of a frame (rgb uint8 [B, 3, H, W], depth [B, H, W]) and their pixels, where the evidence tells things
        apart; else what is seen is no card, and those that there were are gone from sight."""
        if not {"objects", "instances"} <= set(observation):
            none, nothing = objects.empty(len(rgb)), torch.zeros_like(depth, dtype=torch.uint8)
            return {"billboards": none, "billboards_before": none, "instances": nothing}
        told, instances = torch.as_tensor(observation["objects"]).float(), torch.as_tensor(observation["instances"])
        fits = told.shape == (len(rgb), objects.config.rows, 4) and instances.ndim == 3 and len(instances) == len(rgb)
        if not fits or instances.dtype != torch.uint8 or not torch.isfinite(told).all():
            raise ObservationError(
                f"objects is finite float [B, {objects.config.rows}, 4] and instances uint8 [B, h, w]; got {tuple(told.shape)} "
                f"and {instances.dtype} {tuple(instances.shape)}."
            )
        named = F.pad(
            (told[..., 0] > 0).to(torch.uint8), (1, 255 - objects.config.rows)
        )  # a pixel of nobody is nobody's
        instances = instances * named.gather(1, instances.flatten(1).long()).view(instances.shape)
        instances = F.adaptive_max_pool2d(instances[:, None].float(), depth.shape[-2:])[:, 0].to(torch.uint8)
        cut = cut_out(rgb, instances, depth, told[..., 1:], pose, self.config.camera)
        billboards = objects.recognised(cut, told, prior["billboards_before"])
        return {"billboards": billboards, "billboards_before": billboards, "instances": instances}

    def _stepped(self, state: State, before: State, rng: torch.Generator) -> State:
        """`state`, a step after `before`, with the cards of then: those that were in sight have done something."""
        if self.objects is None:
            return state
        billboards = self.objects.step(before["billboards"], _in_sight(before), state["pose"], state["actions"], rng)
        return state.replace(billboards=billboards, billboards_before=before["billboards"])

    def _painted(
        self, objects: Objects, state: State, rgb: torch.Tensor, depth: torch.Tensor
    ) -> tuple[State, torch.Tensor, torch.Tensor]:
        """The frame (rgb uint8 [B, 3, H, W], depth [B, H, W]) with the cards of `state` before it, and `state` that knows
        where they are."""
        parts = rgb.float() / 255, depth, state["pose"], self.config.camera
        painted, depth, instances = objects.paint(state["billboards"], *parts)
        things = torch.maximum(state["things"], (instances > 0).float())
        return state.replace(things=things, instances=instances), (painted * 255).round().to(torch.uint8), depth

    def _arrive(
        self, observation: Mapping[str, torch.Tensor], estimator: Estimator, prior: State | None, rng: torch.Generator
    ) -> State:
        rgb, (height, width) = torch.as_tensor(observation["rgb"]), self.config.size
        if rgb.dtype != torch.uint8 or rgb.ndim != 4 or rgb.shape[1:] != (height, width, 3):
            raise ObservationError(f"rgb is uint8 [B, {height}, {width}, 3]; got {tuple(rgb.shape)}.")
        picture = rgb.permute(0, 3, 1, 2).contiguous()
        if prior is None:
            config = self.config
            seen = arrive(picture, estimator, self.memory, self._small, self.starts, config.camera, config.sources)
            pose, depth, lone = seen.pose, seen.depth, ~seen.found
        else:
            pose, depth = prior["pose"], estimator.depth(picture)
            lone = prior["gone"][:, 3] > 0 if self.uncertainty is not None else None
        state = self.observe({**observation, "rgb": rgb, "depth": depth, "pose": pose}, prior, rng)
        if self.uncertainty is None or lone is None:
            return state
        strange = (10 * (estimator.strangeness(picture) - 0.95)).clamp(0, 1) * lone
        gone = torch.cat([torch.zeros(len(rgb), 3), lone[:, None].float(), strange[:, None]], 1)
        state = state.replace(gone=gone)
        glimpse, last, told = self.shown(state, state)  # what the world itself would draw of the picture
        noise = torch.randn(len(rgb), 4, height, width, generator=rng)
        there = next(self.generator.parameters()).device
        parts = noise.to(there), glimpse.to(there), last.to(there), told.to(there)
        clean = generate(self.generator, *parts, self.config.steps).cpu()
        return state.replace(uncertainty=self._expected_error(state, glimpse, last, clean))

    def _gone(self, state: State, before: State, moved: torch.Tensor | None) -> State:
        """`state`, one step further from its evidence than `before`: after a predicted step `moved` [B, 2], or (None) where
        a pose was given."""
        if self.uncertainty is None:
            return state
        gone = before["gone"].clone()
        gone[:, 0] += 1
        if moved is None:
            gone[:, 1:3] = 0
        else:
            turn = yaw(state["pose"]) - yaw(before["pose"])
            gone[:, 1] += moved.norm(dim=-1)
            gone[:, 2] += torch.atan2(turn.sin(), turn.cos()).abs()
        return state.replace(gone=gone)

    def _expected_error(self, state: State, glimpse: Glimpse, last: torch.Tensor, clean: torch.Tensor) -> torch.Tensor:
        """The error [B] to expect of a frame `clean` that was drawn for `state` from `glimpse` and `last`."""
        assert self.uncertainty is not None
        pose, gone = state["pose"], state["gone"]
        angle = (self._headings - yaw(pose)[:, None] + torch.pi) % (2 * torch.pi) - torch.pi
        apart = (
            torch.cdist(pose[:, :3], self.memory.pose[:, :3], compute_mode="donot_use_mm_for_euclid_dist")
            + 2 * angle.abs()
        )
        nearest = apart.min(1).values if len(self.memory) else torch.full((state.batch,), AWAY_M)
        own = self.own.count(state).float() / max(1, self.own.capacity)
        said = [gone[:, :4].clamp_max(128).log1p(), nearest.clamp_max(20)[:, None].log1p(), own[:, None]]
        return self.uncertainty.expected(glimpse, last, clean, torch.cat(said, 1), gone[:, 4])

    def aged(self, state: State, before: State) -> State:
        """`state`, in which the frame of `before` is the one before the last, where things move."""
        return state.replace(**{f"earlier_{part}": before[part] for part in SEEN}) if self.config.moving else state

    def _followed(self, outcome: Outcome, before: State, after: State, action: torch.Tensor, rng) -> State:
        """`after`, the step from `before`, with the reward, end and vitals that `outcome` reads off the two frames: what
        may happen to vitals happens as often as it does."""
        found = outcome(before["rgb"], after["rgb"], action, before["vitals"], before["hidden"], rng)
        return after.replace(vitals=found.vitals, hidden=found.hidden, reward=found.reward, done=found.done > 0)

    def _height(self, before: torch.Tensor, after: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        """The eye's height after a step from place `before` to `after` [B, 2], coming from `z` [B]: it rises as the recorded
        places around do, as far as a step up or down leads there, and leans towards them as it walks."""
        if not len(self.memory):
            return z
        kept = self.memory.pose
        levels = []
        for place in (before, after):
            near = torch.cdist(place, kept[:, :2])
            weight = 1 / (near**2 + 0.01) ** 2 * ((near < 2.5) & ((kept[:, 2] - z[:, None]).abs() < 1.5))
            total = weight.sum(1)
            levels.append(torch.where(total > 0, (weight * kept[:, 2]).sum(1) / total.clamp_min(1e-9), z))
        lean = (0.5 * (after - before).norm(dim=-1)).clamp(max=1.0)
        return z + (levels[1] - levels[0] + lean * (levels[1] - z)).clamp(-0.3, 0.3)

    def _lasting(self, state: State, depth: torch.Tensor) -> torch.Tensor:
        """What a keyframe may keep of the frame's depth."""
        return still(depth, state["things"]) if self.config.moving else depth

    def _walk(self, state: State, wish: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The displacement [B, 2] and the speed left [B, 2] of a body that wishes to move by `wish` [B, 2] among the walls
        that memory and the dream have seen."""
        own = self.own.walls(state)
        if self.objects is not None:
            sides = [
                self.objects.bodies(state["billboards"][view], state["pose"][view, :3], self.config.body_m)
                for view in range(state.batch)
            ]
            own = torch.cat([own, torch.nn.utils.rnn.pad_sequence(sides, batch_first=True, padding_value=NOWHERE)], 1)
        return slide(self._walls, state["pose"][:, :2], wish, self.config.body_m, self.config.short, own)

    def _draw(self, state: State, before: State, rng: torch.Generator) -> State:
        """The frame at `state`'s pose, from memory, `before`'s frame and the generator."""
        glimpse, last, told = self.shown(state, before)
        noise = torch.randn(state.batch, 4, *self.config.size, generator=rng)
        there = next(self.generator.parameters()).device
        parts = noise.to(there), glimpse.to(there), last.to(there), told.to(there)
        clean = generate(self.generator, *parts, self.config.steps).cpu()
        if self.uncertainty is not None:
            state = state.replace(uncertainty=self._expected_error(state, glimpse, last, clean))
        return self.drawn(state, glimpse, clean)

    def shown(self, state: State, before: State) -> tuple[Glimpse, torch.Tensor, torch.Tensor]:
        """What the generator gets (glimpse, last, told) to draw the frame at `state`'s pose, `before` being the last."""
        config, pose = self.config, state["pose"]
        glimpse = self.own.look(state, pose, config.sources, config.slots, self.memory)
        if config.moving:
            frames = []
            for age in ("", "earlier_"):
                rgb, depth, things, at, instances = (before[f"{age}{part}"] for part in SEEN)
                frames.append(Frame(rgb, depth, things, at, covering(instances, things)))
            told = torch.cat([context_thumbnail(before["rgb"]), state["actions"].flatten(1)], 1)
            return glimpse, carry_frames(frames[0], frames[1], pose, config.camera), told
        last = carry(before["rgb"], before["depth"], before["pose"], glimpse, pose, config.camera)
        return glimpse, last, context_thumbnail(before["rgb"])

    def drawn(self, state: State, glimpse: Glimpse, clean: torch.Tensor) -> State:
        """`state` with the frame `clean` [B, 4, H, W] that the generator drew of it from `glimpse`, remembered if new."""
        rgb = ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
        depth, known = decode_depth(clean[:, 3]), glimpse.known
        if self.config.moving:
            state = state.replace(things=clean[:, 4].sigmoid())
            if self.objects is not None:
                state, rgb, depth = self._painted(self.objects, state, rgb, depth)
            known = known * (state["things"] < 0.5)
        kept = self.own.dreamt(state, rgb, self._lasting(state, depth), state["pose"], known)
        return state.replace(rgb=rgb, depth=depth, known=(known * 255).round().to(torch.uint8), **kept)


def _in_sight(state: State) -> torch.Tensor:
    """Which of the cards [B, K] the last frame shows."""
    rows = torch.arange(1, state["billboards"].shape[1] + 1)
    return (state["instances"].flatten(1)[:, None] == rows[:, None]).any(-1)


def own_memory(config: VideoConfig) -> Memory:
    """The memory of a story's own; where its budget has no room, one of the last frame, which each new one replaces."""
    whole = Memory(config.camera, config.size, config.memory_mb, config.new_view, config.known_enough)
    if whole.capacity:
        return whole
    frame_mb = Memory(config.camera, config.size).keyframe_bytes / 2**20
    return Memory(config.camera, config.size, frame_mb, (1e-6, 1e-6), 2.0)


def carry(
    rgb: torch.Tensor,
    depth: torch.Tensor,
    pose: torch.Tensor,
    glimpse: Glimpse,
    target_pose: torch.Tensor,
    camera: Intrinsics,
) -> torch.Tensor:
    """The last frame (rgb uint8 [B, 3, H, W]) warped into the new view where no keyframe knows it, and its trust:
    [B, 4, H, W], 0 elsewhere. A frame that is warped again at every step blurs; a keyframe is warped once."""
    return carry_unknown(rgb, depth, pose, glimpse.known, glimpse.depth, target_pose, camera)
