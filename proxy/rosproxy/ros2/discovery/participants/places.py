"""Which participant ends in favour of a new participant, so that no source takes all places.

There are places for proven participants, and places for unproven participants with perhaps forged
sources. A participant takes no place of the other kind. Proven places are shared out fairly among
*owners*. The owner of an address is the address itself, or its subnet.
"""

from collections import Counter
from collections.abc import Callable, Sequence

from rosproxy.ros2.registry.participants import AnyParticipant

Owner = Callable[[str], str]
"""Returns the owner of an address."""


def oldest_unproven(unproven: Sequence[AnyParticipant], most: int) -> AnyParticipant | None:
    """The unproven participant that ends in favour of a new participant; None if there is room.

    There is room for ``most`` participants. The oldest ends, because this participant has had the
    longest time to prove an address. ``unproven`` are in order of arrival.
    """
    return unproven[0] if len(unproven) >= most else None


def fairer_place(
    proven: Sequence[AnyParticipant], most: int, source: str, owner: Owner
) -> AnyParticipant | None:
    """The proven participant that ends in favour of a new participant at ``source``; or None.

    This is the newest participant of the largest owner, which has most participants. None if there
    is room for a further participant, up to ``most``. None also if the owner of ``source`` would
    then have at least as many participants as the largest owner has now.
    """
    if len(proven) < most:
        return None
    counts = Counter(owner(participant.address) for participant in proven)
    [(largest, count)] = counts.most_common(1)
    if count <= counts[owner(source)] + 1:
        return None
    return next(p for p in reversed(proven) if owner(p.address) == largest)


def surplus(proven: Sequence[AnyParticipant], most: int, owner: Owner) -> list[AnyParticipant]:
    """The participants that have to end so that ``most`` remain.

    In each step this is the newest participant of the owner with most participants.
    """
    left = list(proven)
    ended = list[AnyParticipant]()
    while len(left) > most:
        [(largest, _)] = Counter(owner(participant.address) for participant in left).most_common(1)
        newest = next(p for p in reversed(left) if owner(p.address) == largest)
        left.remove(newest)
        ended.append(newest)
    return ended
