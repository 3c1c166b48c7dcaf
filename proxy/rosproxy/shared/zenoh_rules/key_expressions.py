"""Key expressions of zenoh that match the same names as a glob of the policy.

rmw_zenoh uses these keys (rmw_zenoh_cpp/src/detail/liveliness_utils.cpp):

    DOMAIN/NAME/TYPE/HASH                           data of a topic, or calls of a service
    DOMAIN/NAME/TYPE/HASH/@adv/pub|sub/...          the cache of a latched topic, and its readers
    @ros2_lv/DOMAIN/.../KIND/ENCLAVE/NAMESPACE/NODE/MANGLED_NAME/TYPE/HASH/QOS    a token

NAME has a chunk for each part between two slashes. In MANGLED_NAME, which is a single chunk, ``%``
stands for ``/``. In key expressions ``*`` stands for a chunk, ``**`` for any number of chunks, and
``$*`` for any characters within a chunk. No wildcard matches a chunk that begins with ``@``.

In a glob, ``*`` also matches ``/``. So a glob may need several key expressions for keys of data.
"""

import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import product

from rosproxy.shared.setting_kinds import TopicLimit

MOST_STARS = 3
"""Most ``*`` with text on both sides in a glob. Each doubles the number of key expressions."""
_FOREIGN = re.compile(r"[$#%@]|//|/$")
"""Texts that no name of ROS 2 has."""


def check_glob(glob: str) -> None:
    """Raise ValueError if key expressions cannot match the same names as a glob."""
    if "?" in glob:
        raise ValueError(f"rmw_zenoh has no ? in {glob}. Write names, or *")
    stars = len(re.findall(r"(?<=[^/])\*(?=[^/])", with_single_stars(glob)))
    if stars > MOST_STARS:
        text = f"rmw_zenoh takes at most {MOST_STARS} * within names, {glob} has more"
        raise ValueError(f"{text}. Shorten the glob")


def matches_no_name(glob: str) -> bool:
    """Whether a glob has characters that no name of ROS 2 has, and so matches no name."""
    return _FOREIGN.search(glob) is not None


def check_limits(limits: Sequence[TopicLimit]) -> None:
    """Raise ValueError, with the limit, if zenoh cannot count the messages of a limit."""
    for limit in limits:
        try:
            check_glob(limit.glob)
        except ValueError as error:
            raise ValueError(f"{limit}: {error}") from None
        if matches_no_name(limit.glob):
            raise ValueError(f"{limit}: no topic of ROS 2 has such a name")
        if len(data_keys(limit.glob)) > 1:  # zenoh would count each key expression by itself
            text = "write * for whole parts of a name, or at the end: /camera/*, /*/image, /cam*"
            raise ValueError(f"{limit}: {text}")


def with_single_stars(glob: str) -> str:
    """The glob with a single ``*`` in place of several: both match the same names."""
    return re.sub(r"\*+", "*", glob)


@lru_cache(maxsize=4096)
def data_keys(glob: str) -> tuple[str, ...]:
    """The key expressions for data of the names that match a glob."""
    return tuple(_joined(["*", *path, "*", "*"]) for path in _paths(glob))


def in_cache(key: str, owner: str) -> str:
    """The key expression for the caches of latched topics with this key.

    ``owner`` is ``pub`` or ``sub``; ``**`` stands for both.
    """
    return f"{key}/@adv/**" if owner == "**" else f"{key}/@adv/{owner}/**"


def token_key(glob: str, kind: str) -> str:
    """The key expression of the tokens of a kind, such as ``MP``, for the names of a glob."""
    name = with_single_stars(glob).replace("/", "%")
    chunk = "*" if name == "*" else name.replace("*", "$*")
    return f"@ros2_lv/*/*/*/*/{kind}/*/*/*/{chunk}/*/*/*"


def _paths(glob: str) -> Iterator[list[str]]:
    """The chunks of the names that match a glob, one list for each alternative."""
    parts = with_single_stars(glob).split("/")
    if parts[0] == "":  # a name begins with a slash
        parts = parts[1:]
    elif parts[0] == "*" and len(parts) > 1:  # "*/a" matches /a, too: the "*" may be empty
        for rest in product(*map(_chunks, parts[1:])):
            yield ["**", *(chunk for chunks in rest for chunk in chunks)]
        return
    for alternative in product(*map(_chunks, parts)):
        yield [chunk for chunks in alternative for chunk in chunks]


def _chunks(part: str) -> list[list[str]]:
    """The chunks of a part between two slashes of a glob, one list for each alternative."""
    if part == "*":
        return [["*", "**"]]
    first, *rest = part.split("*")
    alternatives = [[first]]
    for index, text in enumerate(rest):
        is_last = index == len(rest) - 1
        alternatives = [
            further
            for chunks in alternatives
            for further in _with_star(chunks, text, is_last=is_last)
        ]
    return [[chunk for chunk in chunks if chunk] for chunks in alternatives]


def _with_star(chunks: Sequence[str], text: str, *, is_last: bool) -> Iterator[list[str]]:
    """Yield chunks with a ``*`` and a text appended.

    One alternative has the ``*`` within a chunk. In the other, the ``*`` also stands for slashes.
    """
    *before, last = chunks
    if not last and not before:  # at the begin of a part
        yield ["**", f"$*{text}"]
    elif is_last and not text:  # at the end of a part
        yield [*before, f"{last}$*", "**"]
    else:
        yield [*before, f"{last}$*{text}"]
        yield [*before, f"{last}$*", "**", f"$*{text}"]


def _joined(chunks: Sequence[str]) -> str:
    """A canonical key expression: of adjacent ``**`` one is kept, and each ``*`` precedes it."""
    result: list[str] = []
    for chunk in chunks:
        if chunk == "**" and result and result[-1] == "**":
            continue
        if chunk == "*" and result and result[-1] == "**":
            result.insert(len(result) - 1, chunk)
        else:
            result.append(chunk)
    return "/".join(result)
