"""The colours of figures and videos. Colour-blind readers can tell those of the modes apart, too."""

from collections.abc import Sequence

RGB = tuple[int, int, int]

INK, WHITE = "#232830", "#ffffff"
# Of the first, second, ... mode of a run: blue and vermilion of Okabe and Ito, then teal, wine, sand, brown,
# yellow and indigo, which normal, protan and deutan eyes tell apart.
MODES = (
    "#0072b2", "#d55e00", "#44aa99", "#882255", "#ddcc77", "#661100", "#f0c419", "#332288",
)  # fmt: skip
POLICY = "#2d323c"  # the stage-1 policy
OVERLAP = "#c9b8d8"  # where extended sets overlap
GOOD, BAD = "#007d55", "#be2823"


def place(mode: int, modes: Sequence[int]) -> int:
    """Returns the place of a mode among those of a run, in ascending order; 0 is the first."""
    return sorted(modes).index(mode)


def rgb(colour: str) -> RGB:
    """Returns red, green and blue, 0 to 255, of a colour like "#0072b2"."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def light(colour: RGB) -> bool:
    """Returns whether dark words can be read better than white ones on a colour, by its luminance."""
    red, green, blue = ((share / 255) ** 2.2 for share in colour)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.3
