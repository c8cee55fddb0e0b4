"""A program that makes, resets and steps an environment within limits of time and memory; see `making`.

It runs in a process of its own, `python first_trial.py SECONDS MEMORY < description`, where that is a JSON
object of arguments of `Description`. It writes a JSON object with the `problem` because of which the
environment is refused, "" if there is none.
"""

import json
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # of the package, if it is not installed

from hyrl_mj.environments.instance import Instance
from hyrl_mj.environments.opening import Description, register, with_arrays
from hyrl_mj.environments.specification import EnvironmentSpec
from hyrl_mj.errors import BadInput
from hyrl_mj.files import trust
from hyrl_mj.system import limits


def main() -> None:
    seconds, memory = map(int, sys.argv[1:])
    description, problem = Description(**json.load(sys.stdin, object_hook=with_arrays)), ""
    assert isinstance(description.env, str)
    register(description.env)
    # What code of the user's has registered, in the other process alone, cannot be tried in this one.
    if ":" in description.env or description.env in gym.registry:
        limits.limit(seconds, memory)
        try:
            with trust.received():  # code that an argument names does not run
                instance = Instance(EnvironmentSpec(description))
                instance.reset()
                instance.stepped(instance.drawn(np.random.default_rng(0)))
        except BadInput as error:
            problem = str(error)
        except MemoryError:
            needs = f"needs more than {memory >> 20} MB of memory"
            problem = f"the environment {description.name} {needs}"
    print("\n" + json.dumps({"problem": problem}))


if __name__ == "__main__":
    main()
