"""A program that compiles and steps an MJCF file within limits of time and memory; see `mjcf.load`.

It runs in a process of its own, `python mjcf_trial.py SECONDS MEMORY FILE`, and writes a JSON object: empty,
or with the `problem` because of which the file is refused.
"""

import json
import runpy
import sys
from pathlib import Path

import mujoco

LARGEST = 2**27  # [bytes]


def main() -> None:
    seconds, memory, path = sys.argv[1:]
    limits = runpy.run_path(str(Path(__file__).parents[1] / "system" / "limits.py"))
    limits["limit"](int(seconds), int(memory))
    mujoco.set_mju_user_warning(lambda text: None)  # or they are written to a file
    result = {}
    try:
        model = mujoco.MjModel.from_xml_path(path)
    except ValueError as error:
        result["problem"] = " ".join(str(error).split())[:300]
    else:
        if (size := mujoco.mj_sizeModel(model)) > LARGEST:
            result["problem"] = (
                f"its model takes {size / 2**20:.0f} MiB, more than {LARGEST / 2**20:.0f}: give smaller "
                "textures, meshes or height fields"
            )
        data = mujoco.MjData(model)
        for _ in range(2):
            mujoco.mj_step(model, data)
    json.dump(result, sys.stdout)


if __name__ == "__main__":
    main()
