#!/usr/bin/env python
"""Draws the figures of the gallery in the manual, as small pictures, from finished runs.

python scripts/gallery.py runs/unit_circle runs/vehicle --out docs/images
"""

import argparse
import sys
from io import BytesIO
from pathlib import Path

from PIL import Image

import hyrl_mj
from hyrl_mj.errors import HyrlError
from hyrl_mj.files import artifacts

# What is shown of each run, by the end of the name of its picture.
FIGURES = {
    "overview": lambda run: run.plot("overview"),
    "vectors": hyrl_mj.vector_field,
    "robustness": lambda run: run.plot("robustness_map"),
}
# Wide enough for a page of the manual, and a quarter of the bytes of the figures of a run.
DPI, COLOURS = 90, 256


def main() -> None:
    """Writes TASK_overview.png, TASK_vectors.png and TASK_robustness.png for each run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run directories with a worst-case game")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="the folder")
    options = parser.parse_args()
    try:
        for path in options.runs:
            run = hyrl_mj.load_run(path)
            for name, draw in FIGURES.items():
                out = options.out / f"{run.task.name}_{name}.png"
                picture = BytesIO()
                draw(run).savefig(picture, format="png", dpi=DPI, bbox_inches="tight")
                with artifacts.replacing(out) as temporary:
                    small = (
                        Image.open(picture)
                        .convert("RGB")
                        .quantize(COLOURS, Image.Quantize.FASTOCTREE)
                    )
                    small.save(temporary, format="png", optimize=True)
                print(out)
    except HyrlError as error:
        print(f"gallery.py: {error}", file=sys.stderr)
        raise SystemExit(error.exit_status) from None


if __name__ == "__main__":
    main()
