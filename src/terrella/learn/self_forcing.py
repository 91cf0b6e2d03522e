"""train dreams: a finished world goes on learning inside its own dreams, so that long play does not drift.

Self-Forcing (Huang et al. 2025): a world that learned from recorded frames meets its own mistakes only in play. Here it is
shown the start of a recorded stretch and rolls out with its own state - its own frames, its own keyframes - and every
frame it draws is held against the recorded one; the gradient ends at the frame before. What was not determined makes
dream and recording part: there the recorded frame alone would teach a mean of all that could be, so a critic, and a
teacher's distribution where there is one, say what a frame should look like.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..core.errors import DatasetError, TrainingError
from ..core.world import World, make_rng
from ..worlds.folder import Learned
from ..worlds.generator import encode_depth
from ..worlds.history import HistoryWorld
from ..worlds.video import VideoWorld
from .distil import Matching, drawn, follow, learn_critic, noise_for, sum_of, trusted, truth_losses
from .lessons import changing
from .losses import Critic, sharpened
from .post_training import Beside, beside, fingerprint, leave, recipe_of, with_generator
from .samples import Box, Lesson
from .updates import Report, Updates, descend

CONTEXT = 10  # recorded frames before a dream


@dataclass(frozen=True)
class DreamsConfig:
    """Settings of a training on dreams.

    Args:
        steps: Dreams to train on.
        horizon: Frames of a dream; each is one update.
        batch: Dreams at a time.
        learning_rate: Of the generator at its height.
        truth_weight: How hard the recorded frames pull, beside the teacher's distribution; more is nearer to the recording
            and blurs.
        teacher_weight: How hard that pulls, where there is a teacher.
        critic_weight: How hard a critic of small patches pulls, beside the two.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees; by itself the one the world was
            trained without.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth against dream.
        seed: Of everything random.
    """

    steps: int = 150
    horizon: int = 12
    batch: int = 16
    learning_rate: float = 3e-4
    truth_weight: float = 0.05
    teacher_weight: float = 1.0
    critic_weight: float = 1.0
    keep_out: Box | None = None
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    seed: int = 0


class Dreams:
    """`batch` dreams that follow recorded rows: what the generator is shown next, and the frame that was recorded."""

    def __init__(self, pair: Beside, horizon: int, batch: int, rng: np.random.Generator, noise_rng: torch.Generator):
        """Of a world with a memory every other dream is without it: there most must be invented."""
        self.pair, self.world, self.rng = pair, pair.world, noise_rng
        if isinstance(pair.world, VideoWorld) and rng.random() < 0.5:
            self.world = pair.world.without_memory()
        self.row = rng.choice(beginnings(pair, horizon), batch)
        rows = self.row
        self.row = rows - CONTEXT + 1
        seen = pair.recording.evidence(self.world.config, self.row)
        self.state = self.world.observe(seen, None, noise_rng)
        if self.world.config.objects:  # these dreams are of what stands still
            self.state = self.state.replace(cards=torch.zeros_like(self.state["billboards"]))
        while (self.row < rows).all():
            truth = self.next_lesson().truth
            self.go_on(torch.cat([truth[:, :4], 40 * truth[:, 4:] - 20], 1))  # things are drawn as logits
            if self.world.config.objects:
                self.state = self.state.replace(instances=pair.recording.instances(self.row))

    def next_lesson(self) -> Lesson:
        """What the generator is shown of the next frame, and the truth."""
        recording, before = self.pair.recording, self.state
        self.row = self.row + 1
        found, weight = recording.rgb(self.row), None
        if isinstance(self.world, HistoryWorld):
            led = recording.action(self.row - 1)[:, None]
            self.state = before.replace(actions=torch.cat([led, before["actions"][:, :-1]], 1))
            self.glimpse, last, told = self.world.shown(self.state)
            depth = self.glimpse.depth
            weight = changing(found, torch.stack([before["frames"][:, 0], recording.rgb(self.row - 1)], 1))
        else:
            acts = torch.cat([before["actions"][:, 1:], recording.action(self.row - 1)[:, None]], 1)
            self.state = self.world.aged(before.replace(pose=recording.pose(self.row), actions=acts), before)
            self.glimpse, last, told = self.world.shown(self.state, before)
            depth = recording.depth(self.row)
        truth = torch.cat([found.float() / 127.5 - 1, encode_depth(depth)[:, None]], 1)
        if self.world.config.moving:
            truth = torch.cat([truth, recording.things(self.row)[:, None]], 1)
        if self.world.config.objects:
            weight = (~recording.covered(self.row))[:, None].float()
        return Lesson(self.glimpse, last, told, truth, weight)

    @torch.no_grad()
    def go_on(self, clean: torch.Tensor) -> None:
        """The dream continues from the frame that was drawn."""
        clean = clean.detach().cpu()
        if isinstance(self.world, HistoryWorld):
            self.state = self.world.drawn(self.state, clean)
        else:
            self.state = self.world.drawn(self.state, self.glimpse, clean)


def beginnings(pair: Beside, horizon: int) -> np.ndarray:
    """Rows from which `horizon` more can be dreamt, CONTEXT rows being known before them, within one episode and all usable."""
    usable, start = pair.recording.usable, pair.recording.start
    rows = np.arange(CONTEXT - 1, len(usable) - horizon)
    runs = np.cumsum(np.concatenate([[0], usable]))
    whole = runs[rows + horizon + 1] - runs[rows - CONTEXT + 1] == CONTEXT + horizon
    rows = rows[whole & (start[rows - CONTEXT + 1] == start[rows + horizon])]
    if not len(rows):
        raise DatasetError(
            f"no stretch of {CONTEXT + horizon} rows of the recording may be trained on; record more, or dream a shorter --horizon."
        )
    return rows


def like(world: Learned, teacher: World) -> Learned:
    """The teacher; TrainingError unless its generator takes what that of `world` does."""
    if isinstance(teacher, (VideoWorld, HistoryWorld)):
        taken = [
            (
                one.config.size,
                *(one.generator.state_dict()[f"{name}.weight"].shape[1] for name in ("enter", "before.0.time")),
            )
            for one in (world, teacher)
        ]
        if taken[0] == taken[1] and teacher.config.steps > 1:
            return teacher
    raise TrainingError(
        f"{teacher.spec.name} cannot teach {world.spec.name}: a teacher comes from `terrella train video --flow-steps 8` "
        "with the same size and the same recording."
    )


def train_dreams(
    world: World,
    data: str | Path,
    out: str | Path,
    config: DreamsConfig,
    report: Report,
    teacher: World | None = None,
) -> dict:
    """Trains, or goes on with, the run in the folder `out`; the world lies in `out`/world. Returns the run's facts.

    teacher: a world of the same kind that draws a frame in many steps (see `distil`).
    """
    if min(config.steps, config.horizon, config.batch) < 1:
        raise TrainingError("--steps, --horizon and --batch are 1 or more.")
    pair = beside(world, data, config.keep_out, report)
    old, flow_steps = pair.world, pair.world.config.steps
    beginnings(pair, config.horizon)
    torch.manual_seed(config.seed)
    generator = copy.deepcopy(old.generator).train().requires_grad_(True)
    smooth = copy.deepcopy(generator).eval().requires_grad_(False)
    critic, matching = Critic().to(pair.device), None
    if teacher is not None:
        matching = Matching(like(old, teacher).generator.to(pair.device))
    optimiser = torch.optim.AdamW(generator.parameters(), config.learning_rate, (0.9, 0.99), weight_decay=1e-4)
    critic_optimiser = torch.optim.Adam(critic.parameters(), 3e-4, (0.0, 0.99))
    modules = {"generator": generator, "smooth": smooth, "critic": critic}
    optimisers = {"optimiser": optimiser, "critic_optimiser": critic_optimiser}
    recipe = recipe_of(config, old, pair.dataset)
    if matching is not None:
        modules["mimic"], optimisers["mimic_optimiser"] = matching.mimic, matching.optimiser
        recipe["teacher"] = fingerprint(matching.teacher)
    updates = Updates(out, recipe, modules, optimisers)

    def update(step: int) -> dict[str, float]:
        rng = np.random.default_rng([config.seed, step])
        noise_rng = make_rng(int(rng.integers(2**62)))
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * min(1, (step + 1) / 10, (config.steps - step) / (0.3 * config.steps))
        dreams, found = Dreams(pair, config.horizon, config.batch, rng, noise_rng), []
        for frame in range(config.horizon):
            number = step * config.horizon + frame
            lesson = dreams.next_lesson().to(pair.device)
            fresh = drawn(generator, noise_for(pair, config.batch, noise_rng), lesson, flow_steps, rng)
            clean = lesson.judged(fresh)
            losses = truth_losses(clean, lesson)
            loss = config.truth_weight * sum_of(losses)
            if matching is not None:
                losses["teacher"] = matching.towards_teacher(clean, lesson, noise_rng)
                loss = loss + config.teacher_weight * losses["teacher"]
            if config.critic_weight:
                loss = loss + sharpened(critic, clean, loss, lesson.glimpse, config.critic_weight * trusted(number))
            descend(optimiser, loss, number, generator)
            follow(smooth, generator, number)
            real = pair.lesson(config.batch, rng).to(pair.device)
            told = {name: float(value.detach()) for name, value in losses.items()}
            told["critic"] = learn_critic(critic, critic_optimiser, clean, lesson, real, number)
            if matching is not None:
                told["mimic"] = matching.learn(clean, lesson, noise_rng, number)
            dreams.go_on(fresh)
            found.append(told)
        return {name: float(np.mean([one[name] for one in found])) for name in found[0]}

    def draw() -> None:
        facts = {"dreams": f"{updates.facts['step'] * config.batch:,} of {config.horizon} frames"}
        leave(pair, with_generator(old, smooth, flow_steps, facts), old, updates)

    updates.run(config.steps, update, draw, config.save_every_s, config.strip_every_s, report)
    draw()
    return {"world": str(updates.out / "world"), **updates.outcome}
