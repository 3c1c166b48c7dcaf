"""Compare the times that the engine reports."""


def instant(text: str) -> tuple[str, str]:
    """Return a time of the engine in a form that sorts by time."""
    # The engine writes times in Go's RFC3339Nano, which leaves out zeros at the end.
    seconds, _, fraction = text.removesuffix("Z").partition(".")
    return seconds, fraction.ljust(9, "0")
