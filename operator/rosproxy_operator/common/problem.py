"""What is wrong, as it is told for every engine."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that keeps an object from what its user wants; the text says what to do.

    ``subject`` names the object: ``container talker``, ``network app``, ``proxy rosproxy-…``.
    With ``fatal`` the object is left out; otherwise the problem is a warning.
    """

    subject: str
    text: str
    fatal: bool = True
