"""Times in the engine's words, made comparable."""


def instant(text: str) -> tuple[str, str]:
    """A time of the engine's, so that it can be compared: their fractions vary in length."""
    # Go's RFC3339Nano, in which the engine writes times, leaves out zeros at the end.
    seconds, _, fraction = text.removesuffix("Z").partition(".")
    return seconds, fraction.ljust(9, "0")
