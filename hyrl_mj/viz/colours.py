"""The colours of figures and videos. Colour-blind readers can tell those of the modes apart, too."""

from functools import cache

import numpy as np
from PIL import ImageColor

INK, WHITE = "#232830", "#ffffff"
GREY, PALE = "#dcdee2", "#8b919b"  # states at which a run is over, and what counts less
# Of the first, second, ... mode of a run: blue and vermilion of Okabe and Ito, then teal, wine, sand, brown,
# yellow and indigo, which normal, protan and deutan eyes tell apart.
MODES = (
    "#0072b2", "#d55e00", "#44aa99", "#882255", "#ddcc77", "#661100", "#f0c419", "#332288",
)  # fmt: skip
POLICY = "#2d323c"  # the stage-1 policy
OVERLAP, CRITICAL = "#c9b8d8", "#cd1e2d"  # where extended sets overlap, and M* on the floor
OBSERVED = "#f4c9c7"  # what a policy can observe
GOOD, BAD = "#007d55", "#be2823"
OPEN = "#6e747e"  # what has not ended yet


def mode_colour(place: int) -> str:
    """Returns the colour of the first (0), second, ... mode of a run; 8 differ."""
    return MODES[place % len(MODES)]


@cache
def rgba(colour: str) -> np.ndarray:
    """Returns red, green, blue and opacity (4,) float32, 0 to 1, of a colour like "#0072b2"."""
    shares = np.append(ImageColor.getrgb(colour), 255)[:4].astype(np.float32) / 255
    shares.setflags(write=False)
    return shares


def is_light(colour: str) -> bool:
    """Returns whether dark words can be read better than white ones on a colour, by its luminance."""
    red, green, blue = rgba(colour)[:3].astype(float) ** 2.2
    return bool(0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.3)
