"""Guarded: a World around a World that detects steps against the laws of physics, corrects them, and counts both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from ..core import chance
from ..core.errors import TerrellaError
from ..core.spec import kind_of, neutral_action, torch_dtype_of
from ..core.state import State
from ..core.world import Leaping, Observation, World, make_rng, without_end
from .judge import Judge, Judged
from .system import PhysicalSystem
from .tolerance import Tolerance

MAX_DUMPS = 8
FROZEN = 0.5  # of the way that the world predicted: a correction below it stops things
KEPT = ("reward", "done", "done_probability", "spread")  # of the prediction, where a corrected state is observed
_GUARD = "guard."
HELD = _GUARD + "held"


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

    State: that of the world, and guard.held [B, 2, K], the last two instants of the system's channels, one after the other;
    guard.* counts."""

    def __init__(
        self,
        world: World,
        system: PhysicalSystem,
        tolerances: Sequence[Tolerance],
        simulator: World | None = None,
        config: GuardConfig = GuardConfig(),
    ):
        self.world, self.system, self.simulator, self.config = world, system, simulator, config
        world.spec.check_channels(system.channels)
        widths = {name: int(np.prod(world.spec.channels[name].shape or ())) for name in system.channels}
        right = [one for one in tolerances if not one.wrong_here]
        self._judge = Judge(system, right, world.spec.dt_s, widths)
        self.tolerances = self._judge.tolerances
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
        seen, goes_on = self._seen(proposal), ~_done(bare)
        drawn, simulates = self.config.draws > 1, self.simulator is not None
        corrects = goes_on if self.config.project else torch.zeros_like(goes_on)
        first = self._judged(state, seen, torch.zeros_like(goes_on) if drawn or simulates else corrects)
        broken = first.before > 1
        wrong = broken.any(1) & goes_on
        if self.config.dumps is not None and wrong.any():
            self._dump(bare.at(wrong), action[wrong])
        if drawn and wrong.any():
            proposal = self._drawn_again(state, proposal, first.before, wrong, action, seeds)
            seen = self._seen(proposal)
        last, by_simulator = first, torch.zeros_like(goes_on)
        if simulates:
            by_simulator = wrong if self.config.disagreement is None else self._disagrees(bare, action) & goes_on
        if drawn or simulates:
            first = self._judged(state, seen, torch.zeros_like(goes_on))
            given = self._simulated(state, seen, action, by_simulator)
            last = self._judged(state, given, corrects & ~by_simulator)
        changed = last.changed | by_simulator
        if changed.any():
            proposal = self._written(proposal, last.seen, changed, rng)
        counts = {
            "age": 1,
            "broken": broken,
            "left": last.left > 1,
            "corrected": last.changed,
            "simulated": by_simulator,
            "way": torch.stack([first.way[:, 0], last.way[:, 1]], 1),
        }
        counted = {_GUARD + name: state[_GUARD + name] + value for name, value in counts.items()}
        return proposal.replace(**counted, **{HELD: torch.stack([state[HELD][:, 1], last.seen], 1)})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, Tensor]:
        self.spec.check_channels(channels)
        others = [name for name in channels if name not in self.system.channels]
        shown, held = (
            dict(self.world.render(_bare(state), others)) if others else {},
            self._judge.parts(state[HELD][:, 1]),
        )
        return {name: shown[name] if name in shown else self._shaped(name, held[name]) for name in channels}

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
        batch = inner.batch
        given = {name: torch.as_tensor(observation[name]) for name in self.system.channels if name in observation}
        seen = self._seen(inner, given)
        held = {HELD: torch.stack([seen if prior is None else prior[HELD][:, 1], seen], 1)}
        laws = len(self.tolerances)
        zeros = {"age": (), "broken": (laws,), "left": (laws,), "corrected": (), "simulated": (), "way": (2,)}
        for name, shape in zeros.items():
            key = _GUARD + name
            held[key] = torch.zeros(batch, *shape, dtype=torch.float64) if prior is None else prior[key]
        return inner.replace(**held)

    def _seen(self, inner: State, given: Mapping[str, Tensor] = MappingProxyType({})) -> Tensor:
        """The channels of the system, or those given, float64 [B, K]."""
        rest = [name for name in self.system.channels if name not in given]
        shown = {**given, **(self.world.render(inner, rest) if rest else {})}
        flat = [shown[name].detach().cpu().reshape(inner.batch, -1) for name in self.system.channels]
        return torch.cat(flat, 1).double()

    def _judged(self, state: State, seen: Tensor, allowed: Tensor) -> Judged:
        return self._judge(state[HELD], seen, state[_GUARD + "age"] == 0, allowed)

    def _simulated(self, state: State, seen: Tensor, action: Tensor, rows: Tensor) -> Tensor:
        """`seen` with a simulator's step in these rows."""
        if self.simulator is None or not rows.any():
            return seen
        sim, rng = self.simulator, make_rng(0)
        held = self._judge.parts(state[HELD][rows, 1])
        before = {name: self._shaped(name, held[name]) for name in sim.spec.observes if name in held}
        rest = [name for name in sim.spec.observes if name not in before]
        before |= dict(self.world.render(_bare(state).at(rows), rest)) if rest else {}
        same = sim.spec.action == self.spec.action
        taken = (
            action[rows]
            if same
            else torch.from_numpy(neutral_action(sim.spec)).expand(int(rows.sum()), *sim.spec.action.shape)
        )
        after = sim.render(sim.imagine(sim.observe(before, None, rng), taken, rng), self.system.channels)
        flat = torch.cat([after[name].reshape(len(taken), -1).double() for name in self.system.channels], 1)
        return seen.index_put((rows,), flat)

    def _disagrees(self, bare: State, action: Tensor) -> Tensor:
        """bool [B]: a leap and as many single steps under this action end apart."""
        return self.disagreement(bare, action) > (self.config.disagreement or 0.0)

    def disagreement(self, state: State, action: Tensor) -> Tensor:
        """RMS [B] between the latent after one leap, and after as many single steps, under one held action (Hybrid Neural World
        Models, 2026: where predictions over different horizons differ, there is a contact)."""
        world, rng = self.world, make_rng(0)
        if not isinstance(world, Leaping) or not world.spec.leap:
            raise TerrellaError(f"{world.spec.name} has no leaps to compare with single steps.")
        steps, bare = world.spec.leap, without_end(_bare(state))
        far = world.leap(bare, action[:, None].expand(-1, steps, *action.shape[1:]), rng)
        near = bare
        for _ in range(steps):
            near = world.imagine(without_end(near), action, rng)
        ends = [world.render(end, ("latent",))["latent"].double() for end in (far, near)]
        return (ends[0] - ends[1]).square().mean(-1).sqrt().cpu()

    def _drawn_again(
        self, state: State, proposal: State, ratios: Tensor, wrong: Tensor, action: Tensor, seeds: Tensor
    ) -> State:
        """The best of several predictions of the broken steps."""
        bare, best = _bare(state), ratios.amax(1) if ratios.shape[1] else ratios.new_zeros(len(ratios))
        never = torch.zeros(1, dtype=torch.bool)
        for row in wrong.nonzero()[:, 0].tolist():
            one = torch.tensor([row])
            for draw in range(1, self.config.draws):
                rng = make_rng((int(seeds[row]) + draw) % 2**62)
                other = self.world.imagine(bare.at(one), action[one], rng)
                worst = float(self._judged(state.at(one), self._seen(other), never).before.amax())
                if worst < float(best[row]):
                    best[row], proposal = worst, proposal.put(one, other)
        return proposal

    def _written(self, proposal: State, flat: Tensor, rows: Tensor, rng: torch.Generator) -> State:
        """The world's states of these rows, set from the corrected channels [B, K]."""
        every = bool(rows.all())
        mine, parts = (proposal, flat) if every else (proposal.at(rows), flat[rows])
        needed, seen = self.world.spec.observes, self._judge.parts(parts)
        rest = [name for name in needed if name not in seen]
        given = {name: self._shaped(name, seen[name]) for name in needed if name in seen}
        given |= dict(self.world.render(mine, rest)) if rest else {}
        posterior = self.world.observe(given, mine, make_rng(0))
        posterior = posterior.replace(**{name: mine[name] for name in KEPT if name in mine and name in posterior})
        return posterior if every else proposal.put(rows, posterior)

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
