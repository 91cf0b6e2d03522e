"""Any World is a Gymnasium vector environment: four CartPoles side by side, a random policy, Gymnasium's own wrappers."""

from __future__ import annotations

from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

import terrella


def main(world: str = "gym:CartPole-v1", num_envs: int = 4, steps: int = 200) -> dict[str, float]:
    env = terrella.as_env(terrella.load(world, rgb=False), num_envs=num_envs, max_steps=100, seed=0)
    env = NormalizeObservation(RecordEpisodeStatistics(env))
    observations, _ = env.reset(seed=0)
    env.action_space.seed(0)
    returns: list[float] = []
    for _ in range(steps):
        observations, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
    env.close()
    mean = sum(returns) / len(returns)
    print(
        f"{len(returns)} episodes in {num_envs} x {steps} steps, mean return {mean:.1f}, observations {observations.shape}"
    )
    return {"episodes": len(returns), "mean_return": mean}


if __name__ == "__main__":
    main()
