"""How long the document at ``/status`` gets, whatever nodes and strangers call things.

Names are theirs, and so is how many there are: registrations, and connections from outside. All
nodes together have MOST characters for these; who has few is shown in whole, and of the others
each gets as much as the next, so that nobody hides what a neighbour has. Within a node its names
come first, since connections are what anybody outside can add.
"""

import json
from collections.abc import Iterable, Sequence
from itertools import accumulate, chain

import msgspec

from rosproxy.admin.status_document import (
    ConnectionStatus,
    EndpointStatus,
    HiddenStatus,
    ParticipantStatus,
    ProxyStatus,
)

MOST = 512 * 1024
"""Characters of JSON for what nodes have registered and who is connected to them. A hundred nodes
with ten topics and as many connections each have 250,000."""
MOST_HIDDEN = 256 * 1024
"""The same for what the policy hides."""
MOST_OF_PARTICIPANTS = 128 * 1024
"""The same for topics and services of the participants of ROS 2 on one side of a domain."""
CONNECTION = 160
"""Those of a connection besides its texts."""
Item = str | ConnectionStatus
_LISTS = ("nodes", "publishes", "services", "subscribes", "parameters", "connections")


def bounded(status: ProxyStatus, most: int = MOST) -> ProxyStatus:
    """The status with so much of each node's lists that all fit; ``left_out`` counts the rest."""
    wanted = [sum(map(_size, _items(node))) for node in status.nodes]
    if sum(wanted) <= most:
        return status
    shares = fair_shares(wanted, most)
    nodes = (_cut(node, share) for node, share in zip(status.nodes, shares, strict=True))
    return msgspec.structs.replace(status, nodes=tuple(nodes))


def first_hidden(hidden: Sequence[HiddenStatus], most: int = MOST_HIDDEN) -> list[HiddenStatus]:
    """The first of the hidden names, as many as fit."""
    sizes = accumulate(len(msgspec.json.encode(one)) for one in hidden)
    return [one for one, size in zip(hidden, sizes, strict=True) if size <= most]


def bounded_names(
    participants: Iterable[ParticipantStatus], most: int = MOST_OF_PARTICIPANTS
) -> tuple[ParticipantStatus, ...]:
    """Participants with so many of each one's names that all fit."""
    all_of_them = tuple(participants)
    sizes = [[len(msgspec.json.encode(name)) + 1 for name in _names(one)] for one in all_of_them]
    shares = fair_shares([sum(own) for own in sizes], most)
    return tuple(
        _with_names(one, sum(1 for used in accumulate(own) if used <= share))
        for one, own, share in zip(all_of_them, sizes, shares, strict=True)
    )


def _names(one: ParticipantStatus) -> tuple[str, ...]:
    return (*one.publishes, *one.subscribes, *one.services)


def _with_names(one: ParticipantStatus, count: int) -> ParticipantStatus:
    """A participant with the first of its names."""
    subscribed = max(count - len(one.publishes), 0)
    return msgspec.structs.replace(
        one,
        publishes=one.publishes[:count],
        subscribes=one.subscribes[:subscribed],
        services=one.services[: max(subscribed - len(one.subscribes), 0)],
        left_out=one.left_out + len(_names(one)) - count,
    )


def fair_shares(wanted: Sequence[int], most: int) -> list[int]:
    """How much each gets of ``most``: what it wants, or as much as all others that want more."""
    shares, left = [0] * len(wanted), most
    by_size = sorted(range(len(wanted)), key=wanted.__getitem__)
    for served, index in enumerate(by_size):
        shares[index] = min(wanted[index], left // (len(wanted) - served))
        left -= shares[index]
    return shares


def _cut(node: EndpointStatus, share: int) -> EndpointStatus:
    """A node with the first items of its lists, as many as fit."""
    lists: dict[str, tuple[Item, ...]] = {}
    left_out = 0
    for name in _LISTS:
        kept: list[Item] = []
        for item in getattr(node, name):
            share -= _size(item)
            if share >= 0:
                kept.append(item)
            else:
                left_out += 1
        lists[name] = tuple(kept)
    return msgspec.structs.replace(node, **lists, left_out=left_out)


def _items(node: EndpointStatus) -> chain[Item]:
    return chain.from_iterable(getattr(node, name) for name in _LISTS)


def _size(item: Item) -> int:
    """Characters of an item as JSON, with what separates it from the next; about."""
    if isinstance(item, str):
        return len(json.dumps(item)) + 2
    texts = item.kind, item.name, item.caller_id, item.peer
    return CONNECTION + sum(len(json.dumps(text)) for text in texts)
