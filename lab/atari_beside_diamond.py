"""Breakout learned by Terrella and by DIAMOND's own code from one recording in the same processor time, and scored alike.

    git clone https://github.com/eloialonso/diamond CHECKOUT       # MIT; Alonso et al. 2024
    python lab/atari.py record breakout OUT                    # OUT/rec, OUT/test
    python lab/atari_beside_diamond.py ours CHECKOUT OUT 20    # minutes on one thread; goes on where it stopped
    python lab/atari_beside_diamond.py theirs CHECKOUT OUT M   # its Denoiser, loss, sampler; M: cpu_s / 60 of OUT/run/cpu.json
    python lab/atari_beside_diamond.py score CHECKOUT OUT      # OUT/beside-terrella.json, OUT/beside-diamond.json
    python lab/atari_beside_diamond.py pace CHECKOUT OUT       # milliseconds a frame, in turns

DIAMOND trains as its configuration for Atari says (batches of 32, AdamW 1e-4, 4 frames of context, 3 Euler steps), on the
recorded actions; only what it reads them from is ours. Both see the same episodes and are scored on the other recording.
"""

from __future__ import annotations

import json
import sys
import time
import types
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file

import terrella
from terrella.core import State
from terrella.core.spec import Spec
from terrella.data import ClipCache, split
from terrella.measure import Exam, ExamConfig, as_dict, clips_from_cache, examine

SIZE, CONTEXT, HORIZONS, CLIPS = (64, 64), 4, (1, 8, 32), 50


def import_diamond(checkout: Path) -> types.SimpleNamespace:
    """What is needed of a checkout; the packages that its training stack logs and configures with are not."""
    if not (checkout / "src" / "models" / "diffusion").is_dir():
        sys.exit(f"{checkout} is no checkout of DIAMOND: git clone https://github.com/eloialonso/diamond {checkout}")
    for name, needed in (("wandb", ()), ("omegaconf", ("OmegaConf",))):
        sys.modules.setdefault(name, types.ModuleType(name))
        for part in needed:
            setattr(sys.modules[name], part, object)
    torch.utils.data.Sampler.__init__ = lambda self, data_source=None: None  # which took an argument, once
    sys.path.insert(0, str(checkout / "src"))
    import models.diffusion as diffusion  # pyright: ignore[reportMissingImports]
    import utils  # pyright: ignore[reportMissingImports]
    from data.utils import make_segment  # pyright: ignore[reportMissingImports]

    import data  # pyright: ignore[reportMissingImports]

    return types.SimpleNamespace(data=data, diffusion=diffusion, utils=utils, make_segment=make_segment)


def new_denoiser(diamond, actions: int):
    """As config/agent/default.yaml and config/trainer.yaml have it."""
    inner = diamond.diffusion.InnerModelConfig(
        img_channels=3,
        num_steps_conditioning=4,
        cond_channels=256,
        depths=[2, 2, 2, 2],
        channels=[64, 64, 64, 64],
        attn_depths=[0, 0, 0, 0],
        num_actions=actions,
    )
    config = diamond.diffusion.DenoiserConfig(inner_model=inner, sigma_data=0.5, sigma_offset_noise=0.3)
    return diamond.diffusion.Denoiser(config)


def recorded(diamond, cache: ClipCache):
    """The training episodes of a clip cache as a Dataset of DIAMOND's."""

    class Recorded(diamond.data.Dataset):
        def __init__(self):
            self.episodes = [cache.episodes[number] for number in split(len(cache.episodes))[0]]
            self.lengths = np.array([stop - first for first, stop in self.episodes])
            self.num_episodes, self.num_steps = len(self.lengths), int(self.lengths.sum())

        def __getitem__(self, wanted):
            first, stop = self.episodes[wanted.episode_id]
            shift = max(0, wanted.start)
            rows = slice(first + shift, min(stop, first + wanted.stop))
            rgb = torch.from_numpy(np.array(cache.rgb[rows])).permute(0, 3, 1, 2).float()
            told = (cache.action[rows, 0], cache.reward[rows], cache.done[rows])
            action, reward, end = (torch.from_numpy(np.array(part)) for part in told)
            none = torch.zeros_like(end).byte()
            piece = diamond.data.Episode(rgb.div(255).mul(2).sub(1), action.long(), reward, end.byte(), none, {})
            moved = diamond.data.SegmentId(wanted.episode_id, wanted.start - shift, wanted.stop - shift)
            return diamond.make_segment(piece, moved, should_pad=True)

    return Recorded()


def train_theirs(checkout: Path, out: Path, minutes: float, batch: int = 32) -> None:
    """DIAMOND's denoiser, for `minutes` of processor time in all."""
    diamond = import_diamond(checkout)
    cache = ClipCache.open(out / "rec", SIZE)
    torch.manual_seed(0)
    np.random.seed(0)
    denoiser = new_denoiser(diamond, int(cache.world["action_high"][0]) + 1)
    denoiser.setup_training(
        diamond.diffusion.SigmaDistributionConfig(loc=-0.4, scale=1.2, sigma_min=2e-3, sigma_max=20)
    )
    optimiser = diamond.utils.configure_opt(denoiser, lr=1e-4, weight_decay=1e-2, eps=1e-8)
    warm_up = diamond.utils.get_lr_sched(optimiser, 100)
    episodes = recorded(diamond, cache)
    sampler = diamond.data.BatchSampler(episodes, 0, 1, batch, 4 + 1 + 1, None)
    loader = torch.utils.data.DataLoader(
        episodes, batch_sampler=sampler, collate_fn=diamond.data.collate_segments_to_batch
    )
    folder, facts = out / "diamond", {"steps": 0, "cpu_s": 0.0, "batch": batch}
    folder.mkdir(exist_ok=True)
    if (folder / "run.pt").exists():
        saved = torch.load(folder / "run.pt", weights_only=False)
        facts = saved["facts"]
        denoiser.load_state_dict(saved["denoiser"])
        optimiser.load_state_dict(saved["optimiser"])
        warm_up.load_state_dict(saved["warm_up"])
        np.random.seed(facts["steps"])
    before, saved_at, denoiser = facts["cpu_s"], time.monotonic(), denoiser.train()
    for pieces in loader:
        loss, _ = denoiser(pieces)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(denoiser.parameters(), 1.0)
        optimiser.step()
        optimiser.zero_grad()
        warm_up.step()
        facts["steps"] += 1
        facts["cpu_s"] = before + time.process_time()
        over = facts["cpu_s"] > 60 * minutes
        if facts["steps"] % 10 == 0:
            print(facts, float(loss), flush=True)
        if over or time.monotonic() - saved_at > 60:
            state = {"denoiser": denoiser.state_dict(), "optimiser": optimiser.state_dict(), "facts": facts}
            torch.save({**state, "warm_up": warm_up.state_dict()}, folder / "run.pt")
            saved_at = time.monotonic()
        if over:
            break
    save_file(denoiser.state_dict(), folder / "denoiser.safetensors")
    (folder / "facts.json").write_text(json.dumps(facts))


def train_ours(out: Path, minutes: float, **settings) -> None:
    """All that `terrella train video` does but for the head that says how far it errs, for `minutes`; the processor time
    that it took in all is what DIAMOND should be given."""
    from terrella.learn.recipes.video import TrainConfig, train_video

    folder, before = out / "run", 0.0
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / "cpu.json").exists():
        before = json.loads((folder / "cpu.json").read_text())["cpu_s"]

    def report(done: float, total: float, words: str = "") -> None:
        (folder / "cpu.json").write_text(json.dumps({"cpu_s": before + time.process_time()}))
        print(f"{before + time.process_time():.0f} s", f"{done / total:.3f}", words, flush=True)

    config = TrainConfig(name=out.name, size=SIZE, hours=minutes / 60, uncertainty_frames=0, **settings)
    facts = train_video(out / "rec", folder, config, report)
    (folder / "cpu.json").write_text(json.dumps({"cpu_s": before + time.process_time(), "steps": facts["step"]}))


class Diamond:
    """DIAMOND's denoiser and sampler as a World of pictures."""

    def __init__(self, diamond, denoiser, spec: Spec):
        self.spec = spec
        settings = diamond.diffusion.DiffusionSamplerConfig(num_steps_denoising=3)
        self.sampler = diamond.diffusion.DiffusionSampler(denoiser.eval(), settings)

    def start(self, batch: int, rng: torch.Generator) -> State:
        raise NotImplementedError("it begins with what it is shown")

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        frame = observation["rgb"].permute(0, 3, 1, 2)[:, None]
        if prior is None:
            return State(
                {"frames": frame.repeat(1, 4, 1, 1, 1), "actions": torch.zeros(len(frame), 4, dtype=torch.long)}
            )
        return prior.replace(frames=torch.cat([prior["frames"][:, :-1], frame], 1))

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        actions = torch.cat([state["actions"][:, 1:], action.long().view(-1, 1)], 1)
        with torch.random.fork_rng(), torch.inference_mode():
            torch.manual_seed(int(torch.randint(2**31 - 1, (1,), generator=rng)))
            clean, _ = self.sampler.sample(state["frames"].float() / 127.5 - 1, actions)
        frame = ((clean.clamp(-1, 1) + 1) * 127.5).round().to(torch.uint8)[:, None]
        return State({"frames": torch.cat([state["frames"][:, 1:], frame], 1), "actions": actions})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        return {"rgb": state["frames"][:, -1].permute(0, 2, 3, 1).contiguous()}


def arm(name: str, checkout: Path, out: Path):
    """ "terrella" or "diamond", trained, as a World."""
    ours = terrella.load(out / "run")
    if name == "terrella":
        return ours
    diamond = import_diamond(checkout)
    denoiser = new_denoiser(diamond, int(ours.spec.action.n))  # pyright: ignore[reportAttributeAccessIssue]
    denoiser.load_state_dict(load_file(out / "diamond" / "denoiser.safetensors"))
    return Diamond(diamond, denoiser, replace(ours.spec, channels={"rgb": ours.spec.channels["rgb"]}))


def compare(name: str, checkout: Path, out: Path, longest: int) -> None:
    """Scores one of them, to `longest` steps, on the clips on which the other is scored; writes OUT/beside-NAME.json, and
    strips beside-NAME-N.png."""
    from terrella.measure import strip

    world, cache, rng = arm(name, checkout, out), ClipCache.open(out / "test", SIZE), terrella.make_rng(0)
    clips = clips_from_cache(cache, range(len(cache.episodes)), CONTEXT, max(HORIZONS), CLIPS, rng)
    horizons = tuple(step for step in HORIZONS if step <= longest)
    config = ExamConfig(
        horizons=horizons, control_horizons=(), drop=(1, horizons[-1]), batch=10, closure_deg=(), closure_walk=0,
        long_steps=0, speed_steps=0,
    )  # fmt: skip
    card = examine(Exam({name: world}, {"clips": {"held out": clips}}, config, seed=1))
    used = json.loads((out / ("run/cpu.json" if name == "terrella" else "diamond/facts.json")).read_text())
    (out / f"beside-{name}.json").write_text(json.dumps({"trained": used, "card": as_dict(card)}, indent=1))
    for number, picture in enumerate(card.pictures):
        strip(picture.rows, picture.columns).save(out / f"beside-{name}-{number}.png")
    print(name, used, f"{len(clips)} clips")
    for row in card.rows:
        beside = ", ".join(f"{words} {figure}" for words, figure in row.baselines.items())
        print(row.horizon, row.what, row.figure, row.unit, beside, "" if row.gain is None else f"gain {row.gain}")


def pace(checkout: Path, out: Path, rounds: int = 6, steps: int = 10) -> dict[str, list[float]]:
    """Milliseconds a frame at batch 1, in turns so that both meet the same machine: the least, the median and the most."""
    from terrella.measure.rollouts import actions_at, fold_context

    arms = {name: arm(name, checkout, out) for name in ("terrella", "diamond")}
    cache = ClipCache.open(out / "test", SIZE)
    clip = clips_from_cache(cache, range(len(cache.episodes)), CONTEXT, steps, 1, terrella.make_rng(0))
    found: dict[str, list[float]] = {name: [] for name in arms}
    for _ in range(rounds):
        for name, world in arms.items():
            rng = terrella.make_rng(0)
            state = fold_context(world, clip, rng)
            began = time.perf_counter()
            for step in range(steps):
                state = world.imagine(state, actions_at(world, clip, step), rng)
                world.render(state, ("rgb",))
            found[name].append((time.perf_counter() - began) / steps * 1e3)
    return {name: [min(times), float(np.median(times)), max(times)] for name, times in found.items()}


if __name__ == "__main__":
    torch.set_num_threads(1)
    what, checkout, out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    if what == "ours":
        train_ours(out, float(sys.argv[4]), **json.loads(sys.argv[5]) if len(sys.argv) > 5 else {})
    elif what == "theirs":
        train_theirs(checkout, out, float(sys.argv[4]), *map(int, sys.argv[5:]))
    elif what == "score":
        longest = int(sys.argv[5]) if len(sys.argv) > 5 else max(HORIZONS)
        for name in sys.argv[4:5] or ("terrella", "diamond"):
            compare(name, checkout, out, longest)
    elif what == "pace":
        print(pace(checkout, out))
    else:
        sys.exit(__doc__)
