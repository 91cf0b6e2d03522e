"""python -m lerobot_policy_terrella RUN FOLDER: a policy of Terrella, learned by imitation, as a folder for LeRobot."""

import sys

from terrella.act.imitation import load_network_of_one_body
from terrella.core.errors import TerrellaError

from .modeling_terrella import from_run, save


def main(words: list[str]) -> str | None:
    """None, or what is wrong."""
    if len(words) != 2:
        return __doc__
    try:
        load_network_of_one_body(words[0])  # LeRobot does not say which of several bodies acts
        policy = from_run(words[0])
        save(policy, words[1])
    except (TerrellaError, OSError) as error:
        return str(error)
    print(f"{words[1]} is a policy of LeRobot: --policy.path={words[1]}")
    print(f"it sees {', '.join(policy.config.input_features)}{' and task' * (policy.network.words is not None)}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
