"""Values of the command line that both engines know."""

from rosproxy.net.addresses import HostPort, parse_host_port


def read_image(text: str) -> str:
    """The name of a container image. Raises ValueError."""
    if not text or any(c.isspace() for c in text):
        raise ValueError(f"{text!r} is not the name of an image")
    return text


def read_bind(example: HostPort, optional: bool, text: str) -> HostPort | None:
    """``host:port`` to listen on, such as the ``example``. Raises ValueError.

    ``none`` is None, where that is ``optional``.
    """
    where = parse_host_port(text)
    if where is None and not (optional and text == "none"):
        raise ValueError(f"{text!r} is not of the form {example}")
    return where
