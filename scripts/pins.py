"""Print the pinned requirements of rosproxy and some extras, with hashes, for pip.

    python scripts/pins.py [EXTRA,EXTRA...]

The extra ``build-system`` stands for the build requirements. All pins are in constraints.txt
(``make lock``), with the requiring projects in ``# via`` lines. pyproject.toml has the requirements
of rosproxy and of each extra. The pins must be a requirements file, because pip does not take
hashes from constraints.
"""

import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_VIA = re.compile(r"#\s+(?:via\s*)?(.*)")


class Pin(NamedTuple):
    """A pinned project: name, lines, and the projects that require it."""

    name: str
    text: str
    via: frozenset[str]


def pins(extras: Iterable[str]) -> list[Pin]:
    """Return the pins of rosproxy's requirements with some extras, indirect requirements included.

    Raises KeyError if there is no such extra, LookupError if a requirement has no pin.
    """
    every = list(_read((ROOT / "constraints.txt").read_text()))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = {name for extra in ("", *extras) for name in _required(project, extra)}
    missing = wanted - {pin.name for pin in every}
    if missing:
        raise LookupError(f"constraints.txt has no {', '.join(sorted(missing))}. Run make lock")
    known: set[str] = set()
    while known != wanted:
        known = set(wanted)
        wanted |= {pin.name for pin in every if pin.via & known}
    return [pin for pin in every if pin.name in wanted]


def _required(project: dict[str, Any], extra: str) -> Iterator[str]:
    """Yield the names that rosproxy itself (no extra) or one of its extras requires."""
    if extra == "build-system":
        requirements = project["build-system"]["requires"]
    elif extra:
        requirements = project["project"]["optional-dependencies"][extra]
    else:
        requirements = project["project"]["dependencies"]
    for requirement in requirements:
        own = re.match(r"rosproxy\[([^\]]*)\]", requirement)
        if own:
            for other in own[1].split(","):
                yield from _required(project, other.strip())
        else:
            yield _name(requirement)


def _read(text: str) -> Iterator[Pin]:
    """Yield the pins in a file of ``uv pip compile`` or ``pip-compile``."""
    for block in re.split(r"^(?=[A-Za-z0-9])", text, flags=re.M):
        if not _NAME.match(block):
            continue  # the heading
        lines = block.splitlines()
        comments = [match[1] for line in lines if (match := _VIA.match(line.strip()))]
        via = frozenset(_name(comment) for comment in comments if _NAME.match(comment))
        pinned = "\n".join(line for line in lines if not line.lstrip().startswith("#"))
        yield Pin(_name(block), pinned.rstrip(), via)


def _name(text: str) -> str:
    """Return the name at the start of a requirement, normalised (PEP 503)."""
    match = _NAME.match(text)
    return re.sub(r"[-_.]+", "-", match[0]).lower() if match else ""


if __name__ == "__main__":
    for pin in pins(filter(None, ",".join(sys.argv[1:]).split(","))):
        print(pin.text)
