"""Values of the command line that both engines know."""

from rosproxy.settings import SettingError


def parse_image(text: str) -> str:
    """The name of a container image. Raises SettingError."""
    if not text or any(c.isspace() for c in text):
        raise SettingError("--proxy-image", f"{text!r} is not the name of an image")
    return text
