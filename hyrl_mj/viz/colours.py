"""The colours of figures and videos. Colour-blind readers can tell those of the modes apart, too."""

RGB = tuple[int, int, int]

INK, WHITE = "#232830", "#ffffff"
# Blue, vermilion, purple and sky blue of Okabe and Ito.
MODES = ("#0072b2", "#d55e00", "#aa4499", "#56b4e9")
POLICY = "#2d323c"  # the stage-1 policy
OVERLAP = "#c9b8d8"  # where extended sets overlap
GOOD, BAD = "#007d55", "#be2823"


def rgb(colour: str) -> RGB:
    """Returns red, green and blue, 0 to 255, of a colour like "#0072b2"."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
