"""Demonstrations for BabyAI's missions by the bot that comes with MiniGrid (pip install minigrid), which remembers what it saw.

    terrella record world gym:BabyAI-GoToObj-v0 --adapter examples/06_babyai.py --policy examples/06_babyai.py:teacher@0.1 \
        --out recordings/go --frames 20000 --pictures none
    terrella train policy --method imitation --from recordings/go --sees image direction --out runs/go --real gym:BabyAI-GoToObj-v0
"""

from __future__ import annotations

import functools

from gymnasium import spaces

from terrella.sim.gymnasium import Adapter, Channel


def expert(env) -> int:
    """The bot's next action, 0 to 6, in the present state of a BabyAI environment."""
    from minigrid.utils.baby_ai_bot import BabyAIBot

    if not hasattr(env, "taught"):  # remembers the actions that are taken, from which the bot recovers
        plain = env.step

        @functools.wraps(plain)
        def step(action):
            env.taught["actions"].append(action)
            return plain(action)

        env.step = step
        env.taught = {}
    taught = env.taught
    if taught.get("mission") is not env.instrs:  # a new episode
        taught.update(mission=env.instrs, bot=BabyAIBot(env), actions=[], steps=-1, advice=0)
    if env.step_count != taught["steps"]:
        try:
            last = taught["actions"][-1] if taught["steps"] >= 0 and taught["actions"] else None
            taught["advice"] = int(taught["bot"].replan(last))
        except Exception:  # the bot lost its plan
            taught["advice"] = int(env.action_space.sample())
        taught["steps"] = env.step_count
    return taught["advice"]


adapter = Adapter(channels={"expert": Channel(expert, spaces.Discrete(7))})


def teacher(seen, rng):
    """A policy that does what the bot advises."""
    return seen["expert"].long().view(-1)
