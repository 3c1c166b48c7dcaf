"""The kind of options that name a container image."""

from rosproxy.shared.setting_kinds import Text


def read_image(text: str) -> str:
    """Check and return the name of a container image. Raises ValueError."""
    if not text or any(c.isspace() for c in text):
        raise ValueError(f"{text!r} is not the name of an image")
    return text


IMAGE = Text("IMAGE", read_image)
