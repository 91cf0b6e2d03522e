"""How fast the position of a finished world drifts: fitted on recordings, checked on another. Its other weights stay.

    python lab/calibrate_drift.py doom-maze --data recordings/explorer recordings/walker --test recordings/test --out OUT

The table: for ten groups of frames of rollouts of 1,000 steps, ordered by the error that is expected, the mean of that and of the
true error; then the same by steps. --everywhere also takes the rows that were kept out of the world's
training. --mean: the rates become the geometric mean of the fitted ones and those of the world, which it was given by
rollouts after fewer shown frames.
"""

import argparse

import torch

import terrella
from terrella.learn.objectives.drift import (
    LONGEST,
    SHOWN,
    DriftFrames,
    ceiling_of,
    drift_frames,
    drift_horizon,
    fit_drift,
    reliability,
)
from terrella.learn.paired import open_paired
from terrella.learn.recording import box_of
from terrella.worlds.folder import save_world

STEPS = (1, 4, 16, 64, 200, 400, 700, 1001)


def expected_of(network, frames: DriftFrames) -> torch.Tensor:
    """The error that is expected of each frame [N]."""
    return frames.expected + (network.ceiling - frames.expected).clamp_min(0) * network.drifts(frames.gone)


def show(network, frames: DriftFrames) -> None:
    expected, error = expected_of(network, frames), frames.error
    for name, order in (("expected", expected), ("true", error)):
        groups = [
            f"{float(expected[at].mean()):.3f}/{float(error[at].mean()):.3f}" for at in order.argsort().tensor_split(10)
        ]
        print(f"expected/true, in tenths by the {name} error:", *groups)
    print("expected over true in tenths:", [round(ratio, 2) for ratio in reliability(expected, error)])
    for low, high in zip(STEPS, STEPS[1:]):
        some = (frames.step >= low) & (frames.step < high)
        if some.any():
            print(f"steps {low} to {high - 1}: expected {expected[some].mean():.3f}, true {error[some].mean():.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world")
    parser.add_argument(
        "--data", nargs="*", default=[], help="recordings to fit on; without them it is checked as it is"
    )
    parser.add_argument("--test", help="the recording to check on")
    parser.add_argument("--out", help="folder of the world with its drift")
    parser.add_argument("--rollouts", type=int, default=4)
    parser.add_argument("--shown", type=int, default=3, help="frames that a rollout observes first")
    parser.add_argument("--mean", action="store_true")
    parser.add_argument("--everywhere", action="store_true")
    asked = parser.parse_args()
    world = terrella.load(asked.world)
    box = None if asked.everywhere else box_of(world.about.card.get("keep_out"))
    plain, network = world.replaced(card={"keep_out": None}), world.uncertainty
    if asked.data:
        every, before = [], network.drift.clone()
        for data in asked.data:
            recording = open_paired(plain, data, box, lambda *_: None).recording
            horizon = min(LONGEST, drift_horizon(recording, 10**6) + SHOWN - asked.shown)
            every.append(drift_frames(plain, recording, horizon, asked.rollouts, shown=asked.shown))
        if len(asked.data) == 1:
            network.ceiling.fill_(ceiling_of(recording, 0))
        frames = DriftFrames(*map(torch.cat, zip(*every)))
        fit_drift(network, frames)
        if asked.mean:
            network.drift.copy_((before * network.drift).sqrt())
        print(f"fitted on {len(frames.step)} frames: ceiling {network.ceiling:.3f}, drift", network.drift.tolist())
        show(network, frames)
    if asked.test:
        recording = open_paired(plain, asked.test, box, lambda *_: None).recording
        print("checked:")
        horizon = min(LONGEST, drift_horizon(recording, 10**6) + SHOWN - asked.shown)
        show(network, drift_frames(plain, recording, horizon, asked.rollouts, seed=1, shown=asked.shown))
    if asked.out:
        facts = {**dict(world.about.card.get("uncertainty", {})), "ceiling": round(float(network.ceiling), 4)}
        save_world(world.replaced(card={"uncertainty": facts}), asked.out)


if __name__ == "__main__":
    main()
