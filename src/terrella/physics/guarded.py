"""Guarded: a World around a World that detects steps against the laws of physics, corrects them, and counts both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from ..core import chance
from ..core.errors import TerrellaError
from ..core.spec import kind_of, neutral_action, torch_dtype_of
from ..core.state import State
from ..core.world import Leaping, Observation, World, make_rng
from .system import PhysicalSystem
from .tolerance import Tolerance
from .trajectory import Trajectory, channels_of, trajectory_of

ORDER = (
    "permanence", "free fall", "momentum", "support and friction", "limits", "energy", "continuity", "non-penetration",
)  # fmt: skip
ROUNDS = 3  # of projections: one may break a law that was kept before
MAX_DUMPS = 8
FROZEN = 0.5  # of the way that the world predicted: a correction below it stops things
KEPT = ("reward", "done", "done_probability", "spread")  # of the prediction, where a corrected state is observed
_GUARD = "guard."


@dataclass(frozen=True)
class GuardConfig:
    """The settings of a Guarded world."""

    # Correct broken steps by projection onto the laws. False: detect and count alone.
    project: bool = True
    # Predictions drawn again for a broken step, of which the best is kept; 1 draws none. For worlds that sample.
    draws: int = 1
    # Ask the simulator where the world disagrees with itself by more than this: one leap against as many single steps, RMS of the
    # latent. Default: where a law is broken.
    disagreement: float | None = None
    # Folder for replayable cases: the state before a broken step, with its action, at most 8.
    dumps: Path | None = None


@dataclass(frozen=True)
class GuardReport:
    """What a guard did, over all episodes of a state."""

    steps: int
    broken: Mapping[str, float]  # law -> the share of steps that broke it as predicted
    left: Mapping[str, float]  # law -> the share of steps that break it still, after correction
    corrected: float  # share of steps
    simulated: float  # share of steps that the simulator took
    change: float  # how far bodies go, over how far the world predicted

    @property
    def frozen(self) -> bool:
        """Whether the corrections stop what the world moves."""
        return self.change < FROZEN

    def __str__(self) -> str:
        laws = "; ".join(
            f"{name} {share:.1%} of steps, {self.left[name]:.1%} after" for name, share in self.broken.items() if share
        )
        words = f"{self.steps} steps; broken: {laws or 'none'}; corrected {self.corrected:.1%}, simulator {self.simulated:.1%}"
        return words + f"; bodies go {self.change:.2f} times as far" + ("; FROZEN" if self.frozen else "")


class Guarded:
    """`Guarded(world, system, tolerances)`: the world, with each step judged and corrected.

    tolerances: of `calibrate`; those of laws that are wrong in this domain are left out. simulator: a World of the same system that
    observes its channels, whose step replaces a broken one. A world is corrected through its channels: it must observe those of the
    system, and no pictures. TerrellaError otherwise.

    State: that of the world, and guard.NAME [B, 2, K], the last two instants of each channel of the system; guard.* counts."""

    def __init__(
        self,
        world: World,
        system: PhysicalSystem,
        tolerances: Sequence[Tolerance],
        simulator: World | None = None,
        config: GuardConfig = GuardConfig(),
    ):
        self.world, self.system, self.simulator, self.config = world, system, simulator, config
        self.tolerances = sorted(
            (one for one in tolerances if not one.wrong_here), key=lambda one: ORDER.index(one.law.name)
        )
        world.spec.check_channels(system.channels)
        pictures = [name for name in world.spec.observes if kind_of(name) == "rgb"]
        changes = config.project or simulator is not None
        if changes and (
            pictures or not set(world.spec.observes) <= set(world.spec.channels) or not world.spec.observes
        ):
            what = f"observes {', '.join(pictures)}" if pictures else "cannot be set from its channels"
            raise TerrellaError(
                f"{world.spec.name} {what}, so a guard cannot correct it; pass project=False to detect alone."
            )
        if simulator is not None:
            self._check_simulator(simulator)
        if config.disagreement is not None and not (simulator and isinstance(world, Leaping) and world.spec.leap):
            raise TerrellaError(
                "a disagreement is between single steps and leaps: it needs a world that leaps, and a simulator."
            )
        self.spec = replace(world.spec, name=f"{world.spec.name} guarded", leap=0)
        self._dumped = 0

    def _check_simulator(self, simulator: World) -> None:
        if lacks := sorted(set(simulator.spec.observes) - set(self.world.spec.channels)):
            raise TerrellaError(
                f"the simulator {simulator.spec.name} observes {', '.join(lacks)}, which the world does not show."
            )
        if not simulator.spec.observes:
            raise TerrellaError(
                f"the simulator {simulator.spec.name} cannot be set to a state, so it cannot step from one."
            )
        if abs(simulator.spec.dt_s - self.world.spec.dt_s) > 1e-6:
            raise TerrellaError(
                f"the simulator steps by {simulator.spec.dt_s:g} s and the world by {self.world.spec.dt_s:g} s; give them one step."
            )
        for name in simulator.spec.observes:
            mine, theirs = self.world.spec.units.get(name), simulator.spec.units.get(name)
            if mine and theirs and mine != theirs:
                raise TerrellaError(
                    f"'{name}' is in {mine} in the world and in {theirs} in the simulator; give both one unit."
                )

    # -- the verbs ----------------------------------------------------------------------------------------------------

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._begun(self.world.start(batch, rng), None)

    def observe(self, observation: Observation, prior: State | None, rng: torch.Generator) -> State:
        bare = None if prior is None else _bare(prior)
        return self._begun(self.world.observe(observation, bare, rng), prior, observation)

    def imagine(self, state: State, action: Tensor, rng: torch.Generator) -> State:
        bare, seeds = _bare(state), chance.seeds(state.batch, rng)
        proposal = self.world.imagine(bare, action, rng)
        predicted = self._motion(state, self._seen(proposal))
        fresh = state[_GUARD + "age"] == 0
        ratios = self._ratios(predicted, fresh)
        broken = ratios > 1
        wrong = broken.any(1) & ~_done(bare)
        if self.config.dumps is not None and wrong.any():
            self._dump(bare.at(wrong), action[wrong])
        if self.config.draws > 1 and wrong.any():
            proposal, predicted, ratios = self._drawn_again(state, proposal, predicted, ratios, wrong, action, seeds)
        motion, by_simulator = predicted, torch.zeros(state.batch, dtype=torch.bool)
        if self.simulator is not None:
            by_simulator = wrong if self.config.disagreement is None else self._disagrees(bare, action) & ~_done(bare)
            motion = self._simulated(state, motion, action, by_simulator)
        if motion is not predicted:
            ratios = self._ratios(motion, fresh)
        if self.config.project:
            motion, ratios = self._projected(motion, ratios, fresh, ~_done(bare) & ~by_simulator)
        left = ratios > 1
        changed = changed_rollouts(predicted, motion)
        flat = {
            name: torch.where(changed[:, None], part, predicted.channels[name][-1])
            for name, part in channels_of(motion).items()
        }
        if changed.any():
            proposal = self._written(proposal, flat, changed, rng)
        way = torch.stack([_way(predicted), _way(motion)], 1)
        counts = {
            "age": 1,
            "broken": broken,
            "left": left,
            "corrected": changed & ~by_simulator,
            "simulated": by_simulator,
            "way": way,
        }
        history = {name: torch.stack([part[-2], flat[name]], 1) for name, part in motion.channels.items()}
        counted = {name: state[_GUARD + name] + value for name, value in counts.items()}
        return proposal.replace(**{_GUARD + name: part for name, part in {**history, **counted}.items()})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, Tensor]:
        self.spec.check_channels(channels)
        others = [name for name in channels if name not in self.system.channels]
        shown = dict(self.world.render(_bare(state), others)) if others else {}
        return {name: shown[name] if name in shown else self._corrected(state, name) for name in channels}

    def report(self, state: State) -> GuardReport:
        """What was done since the episodes of this state began."""
        steps = int(state[_GUARD + "age"].sum())
        every = max(steps, 1)
        names = [one.law.name for one in self.tolerances]
        shares = [(state[_GUARD + kind].sum(0) / every).tolist() for kind in ("broken", "left")]
        way = state[_GUARD + "way"].sum(0)
        return GuardReport(
            steps, dict(zip(names, shares[0])), dict(zip(names, shares[1])), float(state[_GUARD + "corrected"].sum()) / every,
            float(state[_GUARD + "simulated"].sum()) / every, float(way[1] / way[0].clamp_min(1e-12)) if float(way[0]) > 0 else 1.0,
        )  # fmt: skip

    # -- inside -------------------------------------------------------------------------------------------------------

    def _begun(self, inner: State, prior: State | None, observation: Observation = MappingProxyType({})) -> State:
        """What was observed is held as it was observed: a world may clip what lies beyond its training."""
        seen, batch = self._seen(inner), inner.batch
        given = {name: torch.as_tensor(observation[name]) for name in seen if name in observation}
        seen |= {name: part.cpu().double().reshape(batch, -1) for name, part in given.items()}
        before = {name: part if prior is None else prior[_GUARD + name][:, -1] for name, part in seen.items()}
        held = {_GUARD + name: torch.stack([before[name], part], 1) for name, part in seen.items()}
        laws = len(self.tolerances)
        zeros = {"age": (), "broken": (laws,), "left": (laws,), "corrected": (), "simulated": (), "way": (2,)}
        for name, shape in zeros.items():
            key = _GUARD + name
            held[key] = torch.zeros(batch, *shape, dtype=torch.float64) if prior is None else prior[key]
        return inner.replace(**held)

    def _seen(self, inner: State) -> dict[str, Tensor]:
        """The channels of the system, float64 [B, K]."""
        shown = self.world.render(inner, self.system.channels)
        return {name: part.detach().cpu().double().reshape(len(part), -1) for name, part in shown.items()}

    def _motion(self, state: State, seen: Mapping[str, Tensor]) -> Trajectory:
        """The last three instants."""
        rows = {name: torch.cat([state[_GUARD + name].transpose(0, 1), part[None]]) for name, part in seen.items()}
        return trajectory_of(self.system, rows, self.spec.dt_s)

    def _ratios(self, motion: Trajectory, fresh: Tensor) -> Tensor:
        """The violation of the last step by each law [B, L], in tolerances. fresh: episodes that have one step only."""
        if not self.tolerances:
            return motion.position.new_zeros(motion.batch, 0)
        return torch.stack([_ratio(one, motion, fresh) for one in self.tolerances], 1)

    def _projected(
        self, motion: Trajectory, ratios: Tensor, fresh: Tensor, allowed: Tensor
    ) -> tuple[Trajectory, Tensor]:
        """(motion, ratios) after the projections of the laws that each rollout breaks, in turn. A round works on the rollouts that
        still break a law, and judges them at its end."""
        for _ in range(ROUNDS):
            rows = ((ratios > 1).any(1) & allowed).nonzero()[:, 0]
            if not len(rows):
                break
            part, wrong = motion.at(rows), ratios[rows] > 1
            for one, broken in zip(self.tolerances, wrong.T):
                if broken.any():
                    part = _mixed(part, one.law.correct(part), broken)
            motion = motion.put(rows, part)
            ratios = ratios.index_copy(0, rows, self._ratios(part, fresh[rows]))
        return motion, ratios

    def _simulated(self, state: State, motion: Trajectory, action: Tensor, rows: Tensor) -> Trajectory:
        assert self.simulator is not None
        if not rows.any():
            return motion
        sim, rng = self.simulator, make_rng(0)
        before = {
            name: self._shaped(name, state[_GUARD + name][rows, -1])
            for name in sim.spec.observes
            if name in self.system.channels
        }
        rest = [name for name in sim.spec.observes if name not in before]
        before |= dict(self.world.render(_bare(state).at(rows), rest)) if rest else {}
        same = sim.spec.action == self.spec.action
        taken = (
            action[rows]
            if same
            else torch.from_numpy(neutral_action(sim.spec)).expand(int(rows.sum()), *sim.spec.action.shape)
        )
        after = sim.render(sim.imagine(sim.observe(before, None, rng), taken, rng), self.system.channels)
        seen = {name: part[-1].clone() for name, part in motion.channels.items()}
        for name, part in after.items():
            seen[name][rows] = part.double().reshape(len(part), -1)
        return self._motion(state, seen)

    def _disagrees(self, bare: State, action: Tensor) -> Tensor:
        """bool [B]: a leap and as many single steps under this action end apart."""
        return self.disagreement(bare, action) > (self.config.disagreement or 0.0)

    def disagreement(self, state: State, action: Tensor) -> Tensor:
        """RMS [B] between the latent after one leap, and after as many single steps, under one held action (Hybrid Neural World
        Models, 2026: where predictions over different horizons differ, there is a contact)."""
        world, rng = self.world, make_rng(0)
        if not isinstance(world, Leaping) or not world.spec.leap:
            raise TerrellaError(f"{world.spec.name} has no leaps to compare with single steps.")
        steps, bare = world.spec.leap, _bare(state)
        far = world.leap(bare, action[:, None].expand(-1, steps, *action.shape[1:]), rng)
        near = bare
        for _ in range(steps):
            near = world.imagine(near, action, rng)
        ends = [world.render(end, ("latent",))["latent"].double() for end in (far, near)]
        return (ends[0] - ends[1]).square().mean(-1).sqrt().cpu()

    def _drawn_again(
        self,
        state: State,
        proposal: State,
        motion: Trajectory,
        ratios: Tensor,
        wrong: Tensor,
        action: Tensor,
        seeds: Tensor,
    ) -> tuple[State, Trajectory, Tensor]:
        """The best of several predictions of the broken steps."""
        bare, best = _bare(state), ratios.amax(1) if ratios.shape[1] else ratios.new_zeros(len(ratios))
        fresh = state[_GUARD + "age"] == 0
        for row in wrong.nonzero()[:, 0].tolist():
            one = torch.tensor([row])
            for draw in range(1, self.config.draws):
                rng = make_rng((int(seeds[row]) + draw) % 2**62)
                other = self.world.imagine(bare.at(one), action[one], rng)
                mine = self._motion(state.at(one), self._seen(other))
                worst = float(self._ratios(mine, fresh[one]).amax())
                if worst < float(best[row]):
                    best[row], proposal = worst, proposal.put(one, other)
        motion = self._motion(state, self._seen(proposal))
        return proposal, motion, self._ratios(motion, fresh)

    def _written(self, proposal: State, flat: Mapping[str, Tensor], rows: Tensor, rng: torch.Generator) -> State:
        """The world's states of these rows, set from the corrected channels."""
        mine = proposal.at(rows)
        needed = self.world.spec.observes
        rest = [name for name in needed if name not in flat]
        given = {name: self._shaped(name, flat[name][rows]) for name in needed if name in flat}
        given |= dict(self.world.render(mine, rest)) if rest else {}
        posterior = self.world.observe(given, mine, make_rng(0))
        posterior = posterior.replace(**{name: mine[name] for name in KEPT if name in mine and name in posterior})
        return proposal.put(rows, posterior)

    def _corrected(self, state: State, name: str) -> Tensor:
        return self._shaped(name, state[_GUARD + name][:, -1])

    def _shaped(self, name: str, flat: Tensor) -> Tensor:
        space = self.spec.channels[name]
        return flat.reshape(len(flat), *(space.shape or ())).to(torch_dtype_of(space))

    def _dump(self, bare: State, action: Tensor) -> None:
        assert self.config.dumps is not None
        if self._dumped >= MAX_DUMPS:
            return
        self._dumped += 1
        self.config.dumps.mkdir(parents=True, exist_ok=True)
        bare.replace(action=action).save(self.config.dumps / f"case-{self._dumped}.safetensors")


def replay_case(world: World, file: str | Path, rng: torch.Generator | None = None) -> tuple[State, State]:
    """(the state before, the state after) a step that a guard dumped, predicted again by the world without its guard."""
    state = State.load(file)
    action, before = (
        state["action"],
        State({name: part for name, part in state.items() if name != "action"}, state.arenas),
    )
    return before, world.imagine(before, action, rng or make_rng(0))


def _bare(state: State) -> State:
    """The state of the world inside."""
    return State({name: part for name, part in state.items() if not name.startswith(_GUARD)}, state.arenas)


def _done(state: State) -> Tensor:
    return state["done"].cpu() if "done" in state else torch.zeros(state.batch, dtype=torch.bool)


def _ratio(one: Tolerance, motion: Trajectory, fresh: Tensor) -> Tensor:
    """The violation of the last step by a law [B], in tolerances, judged once for each motion. fresh: episodes that have one step
    only."""
    if (ratio := motion.memo.get(one.law.name)) is None:
        whole = one.law.residual(motion)[-1]
        if fresh.any():
            whole = torch.where(fresh, one.law.residual(motion.between(1, 3))[-1], whole)
        ratio = motion.memo[one.law.name] = (whole / one.value).nan_to_num(nan=torch.inf)
    return ratio


def _way(motion: Trajectory) -> Tensor:
    """The way of all bodies in the last step [B], m; a jump counts as far as the larger speed reaches."""
    reach = motion.velocity[-2:].norm(dim=-1).amax(0) * motion.dt_s
    return torch.minimum((motion.position[-1] - motion.position[-2]).norm(dim=-1), reach).sum(-1)


def changed_rollouts(before: Trajectory, after: Trajectory) -> Tensor:
    """bool [B]: the rollouts whose last instant differs."""
    if before is after:
        return torch.zeros(before.batch, dtype=torch.bool)
    parts = [
        (getattr(before, name), getattr(after, name))
        for name in ("position", "velocity", "rotation", "spin", "present")
    ]
    parts += [(part, after.channels[name]) for name, part in before.channels.items()]
    return torch.stack([(one[-1] != other[-1]).flatten(1).any(1) for one, other in parts]).any(0)


def _mixed(motion: Trajectory, other: Trajectory, rows: Tensor) -> Trajectory:
    """The rollouts `rows` (bool [B]) of `other`, the rest of `motion`."""
    parts: dict[str, Any] = {}
    for name in ("position", "velocity", "rotation", "spin", "present", "radius"):
        mine, theirs = getattr(motion, name), getattr(other, name)
        parts[name] = torch.where(rows.view(1, -1, *[1] * (mine.ndim - 2)), theirs, mine)
    channels = {
        name: torch.where(rows[None, :, None], other.channels[name], part) for name, part in motion.channels.items()
    }
    return replace(motion, **parts, channels=channels)
