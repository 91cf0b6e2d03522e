"""One planner, two worlds: it balances CartPole by trying futures in the truth, then in a model learned on the spot.

The planner asks a world for the channels `reward` and `done` and for nothing else, so it cannot tell a simulator from
a neural network. Acting in the truth and filtering what is seen is the same for both: observe(seen, imagine(state)).
"""

from __future__ import annotations

import torch
from gymnasium import spaces

from terrella.core import Spec, State, World, make_rng, rollout
from terrella.core.policy import Reactive
from terrella.core.spec import DONE, REWARD
from terrella.sim.gymnasium import GymnasiumConfig, GymnasiumWorld


def plan(world: World, state: State, rng: torch.Generator, samples: int = 32, horizon: int = 20) -> torch.Tensor:
    """Actions [horizon, 1, ...] of the best of `samples` random futures of `state` (batch 1), by the summed reward."""
    actions = torch.stack([world.spec.sample_action(samples, rng) for _ in range(horizon)])
    dreamt = rollout(world, state.fork(samples), actions, rng, ("reward",)).observations["reward"]
    best = int(dreamt[1:].sum(0).argmax())
    return actions[:, best : best + 1]


def act(truth: World, model: World, steps: int, seed: int, commit: int = 2) -> int:
    """Steps survived in `truth` of `steps`, when the first `commit` actions of each plan made in `model` are taken."""
    rng = make_rng(seed)
    state, belief = truth.start(1, make_rng(seed)), model.start(1, make_rng(seed))
    belief = model.observe(truth.render(state, model.spec.observes), belief, rng)
    queue: list[torch.Tensor] = []
    for step in range(steps):
        queue = queue or list(plan(model, belief, rng)[:commit])
        action = queue.pop(0)
        state = truth.imagine(state, action, rng)
        belief = model.observe(truth.render(state, model.spec.observes), model.imagine(belief, action, rng), rng)
        if truth.render(state, ("done",))["done"]:
            return step + 1
    return steps


class LearnedCartPole:
    """CartPole as a small network has it: the change of the observation, and whether that is the end."""

    def __init__(self, truth: World):
        observation = truth.spec.channels["observation"]
        self.spec = Spec(
            name="learned-cartpole",
            action=truth.spec.action,
            channels={"observation": spaces.Box(-1e6, 1e6, observation.shape), "reward": REWARD, "done": DONE},
            observes=("observation",),
            dt_s=truth.spec.dt_s,
        )
        self._starts = truth.render(truth.start(64, make_rng(0)), ("observation",))["observation"]
        self._net = torch.nn.Sequential(torch.nn.Linear(6, 128), torch.nn.SiLU(), torch.nn.Linear(128, 5))
        self._scale = torch.ones(4)

    def fit(self, seen: torch.Tensor, actions: torch.Tensor, done: torch.Tensor, rng: torch.Generator) -> float:
        """Learns from observations [T + 1, B, 4], actions [T, B] and done [T + 1, B]; gives the last loss."""
        rows = ~done[:-1]
        before, after, action, end = seen[:-1][rows], seen[1:][rows], actions[rows], done[1:][rows].float()
        self._scale = (after - before).std(0)
        with torch.no_grad():
            for tensor in self._net.parameters():
                tensor.copy_(torch.randn(tensor.shape, generator=rng) / tensor.shape[-1] ** 0.5)
        optimizer = torch.optim.Adam(self._net.parameters(), 3e-3)
        for _ in range(1500):
            pick = torch.randint(len(before), (256,), generator=rng)
            guess = self._net(self._inputs(before[pick], action[pick]))
            target = (after - before)[pick] / self._scale
            loss = (guess[:, :4] - target).square().mean()
            loss = loss + torch.nn.functional.binary_cross_entropy_with_logits(guess[:, 4], end[pick])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return loss.item()

    def _inputs(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return torch.cat([observation, torch.nn.functional.one_hot(action, 2)], dim=1)

    def _state(self, observation: torch.Tensor) -> State:
        batch = len(observation)
        return State({"observation": observation, "reward": torch.zeros(batch), "done": torch.zeros(batch) > 0})

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._state(self._starts[torch.randint(len(self._starts), (batch,), generator=rng)])

    def observe(self, observation, prior: State | None, rng: torch.Generator) -> State:
        return self._state(observation["observation"])

    @torch.no_grad()
    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        action, done = self.spec.check_action(action, state.batch), state["done"]
        change = self._net(self._inputs(state["observation"], action))
        after = torch.where(done[:, None], state["observation"], state["observation"] + change[:, :4] * self._scale)
        upright = torch.where(done, 0.0, torch.sigmoid(-change[:, 4]))  # the expected reward: the chance to go on
        return State({"observation": after, "reward": upright, "done": done | (upright < 0.5)})

    def render(self, state: State, channels) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        return {name: state[name] for name in channels}


def main(steps: int = 200, episodes: int = 2, seed: int = 0) -> dict[str, float]:
    torch.set_num_threads(1)  # the network is so small that threads would only wait for each other
    rng = make_rng(seed)
    truth = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False))

    stumble = Reactive(lambda seen, rng: truth.spec.sample_action(400, rng))
    stumbling = rollout(truth, truth.start(400, rng), stumble, rng, ("observation", "done"), steps=80)
    seen, done = stumbling.observations["observation"], stumbling.observations["done"]
    learned = LearnedCartPole(truth)
    print(f"learned from 400 stumbling episodes, loss {learned.fit(seen, stumbling.actions, done, rng):.3f}")
    survived = {"at random": float((~done).sum(0).float().mean())}
    for how, model in {"planning in the truth": truth, "planning in the learned world": learned}.items():
        survived[how] = sum(act(truth, model, steps, seed + episode) for episode in range(episodes)) / episodes
    for how, count in survived.items():
        print(f"{how}: balanced for {count:.0f} of {steps} steps")
    return survived


if __name__ == "__main__":
    main()
