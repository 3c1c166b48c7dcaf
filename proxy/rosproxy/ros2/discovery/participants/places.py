"""Which participant gives its place to a new one, so that no source takes the places of all others.

Places are of two kinds, and neither takes those of the other: for participants at addresses that
have proved to receive what the proxy sends, and for all others, whose sources may be forged. The
``owner`` of an address is what has a share of the places, such as the address itself.
"""

from collections import Counter
from collections.abc import Callable, Sequence

from rosproxy.ros2.registry.participants import AnyParticipant

Owner = Callable[[str], str]
"""The owner of an address."""


def oldest_unproven(unproven: Sequence[AnyParticipant], most: int) -> AnyParticipant | None:
    """The unproven participant that ends for a new one, if there are as many as there may be.

    The oldest goes: it has had the longest time to prove that it receives. ``unproven`` are in the
    order in which they came.
    """
    return unproven[0] if len(unproven) >= most else None


def fairer_place(
    proven: Sequence[AnyParticipant], most: int, source: str, owner: Owner
) -> AnyParticipant | None:
    """The proven participant that ends for a new one at ``source``, if there are ``most`` already.

    It is the newest of the owner with most participants; None if that of ``source`` would have as
    many.
    """
    if len(proven) < most:
        return None
    counts = Counter(owner(participant.address) for participant in proven)
    [(largest, count)] = counts.most_common(1)
    if count <= counts[owner(source)] + 1:
        return None
    return next(p for p in reversed(proven) if owner(p.address) == largest)


def surplus(proven: Sequence[AnyParticipant], most: int, owner: Owner) -> list[AnyParticipant]:
    """The participants that end so that ``most`` are left: the newest, of the largest owner."""
    left = list(proven)
    ended = list[AnyParticipant]()
    while len(left) > most:
        [(largest, _)] = Counter(owner(participant.address) for participant in left).most_common(1)
        newest = next(p for p in reversed(left) if owner(p.address) == largest)
        left.remove(newest)
        ended.append(newest)
    return ended
