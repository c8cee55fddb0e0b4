"""A program that makes, resets and steps an environment within limits of time and memory; see `making`.

It runs in a process of its own, `python first_trial.py SECONDS MEMORY < source`, where the source is a JSON
object of what `Source` holds. It writes a JSON object: nothing, or the
`problem` because of which the environment is refused.
"""

import json
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # of the package, if it is not installed

from hyrl_mj import limits
from hyrl_mj.environments.instance import Instance, Recipe
from hyrl_mj.environments.opening import Source, register
from hyrl_mj.errors import BadInput


def main() -> None:
    seconds, memory = map(int, sys.argv[1:])
    told = json.load(sys.stdin)
    result = {}
    try:
        register(told["make"])
        limits.limit(seconds, memory)
        instance = Instance(Recipe(Source(**told)))
        instance.reset()
        instance.stepped(instance.drawn(np.random.default_rng(0)))
    except BadInput as error:
        result["problem"] = str(error)
    except MemoryError:
        result["problem"] = f"it needs more than {memory >> 20} MB of memory"
    sys.stdout.write("\n" + json.dumps(result))


if __name__ == "__main__":
    main()
