"""The robustness of ten independent runs of the paper's problems, and whether each meets its targets.

    python scripts/ten_seeds.py                      # both problems, seeds 0 to 9, eps 0.1
    python scripts/ten_seeds.py --eps 0.2 --tasks vehicle --seeds 0 1 2

The runs are those of `hyrl-mj sweep`. Exit status 1 if some figure misses its target.
"""

import argparse
import sys
from pathlib import Path

import hyrl_mj
from hyrl_mj.viz import print_sweep

PAPER = ("unit_circle", "vehicle")
TINY = 1e-6  # to which the plants are right


def targets(task: str, eps: float) -> dict[str, tuple[float, float]]:
    """Returns the least and the greatest value of each figure that a run must show."""
    if task == "vehicle":
        own = 0.995 if eps <= 0.1 else 0.99
        wanted = {"hyrl_proved": (own, 1.0), "hyrl_not_broken": (own, 1.0)}
        wanted["hyrl_not_broken_without_noise"] = (0.999, 1.0)
        wanted["hyrl_miss_without_noise"] = (0.0, 0.05)
        return wanted | ({"hyrl_proved_any": (0.945, 1.0)} if eps <= 0.1 else {})
    wanted = {"hyrl_proved_any": (1.0, 1.0), "hyrl_proved_any_without_noise": (1.0, 1.0)}
    wanted["hyrl_excursion"] = (0.0, 0.12 if eps <= 0.1 else 0.22)
    times = {"hyrl_proved_time": (0.0, 3.1), "hyrl_proved_time_any": (0.0, 3.4)}
    return wanted | (times if eps <= 0.1 else {})


def main() -> int:
    """Runs and prints; returns 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(PAPER), choices=PAPER)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--eps", type=float, default=0.1, help="bound of the noise")
    parser.add_argument("--out", type=Path, default=Path("runs/seeds"))
    options = parser.parse_args()
    result = hyrl_mj.sweep(
        options.tasks, seeds=tuple(options.seeds), eps=(options.eps,), out=options.out
    )
    print_sweep(result)
    missed = [
        f"{row.name}: {name} is {value}, not from {least:g} to {most:g}"
        for row in result.rows
        for name, (least, most) in targets(row.setting.task, options.eps).items()
        if (value := row.figures.get(name)) is None or not least <= value <= most + TINY
    ]
    print("\n".join(missed) or "every figure meets its target")
    return int(bool(missed))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except hyrl_mj.HyrlError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_status)
