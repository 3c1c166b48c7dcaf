"""Bounds for the document at ``/status``, whatever nodes and strangers call things.

Nodes choose their names and how many they register; anybody outside can add connections. All nodes
together have MOST characters for these. A node with few is shown in whole, and the others get equal
shares, so that none hides what another has. Within a node its names come before its connections.
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
CONNECTION_OVERHEAD = 160
"""Characters of a connection besides its texts."""
ListEntry = str | ConnectionStatus
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
    sizes = accumulate(len(msgspec.json.encode(h)) for h in hidden)
    return [h for h, size in zip(hidden, sizes, strict=True) if size <= most]


def bounded_names(
    participants: Iterable[ParticipantStatus], most: int = MOST_OF_PARTICIPANTS
) -> tuple[ParticipantStatus, ...]:
    """Participants with so many of each one's names that all fit."""
    all_participants = tuple(participants)
    sizes = [[len(msgspec.json.encode(name)) + 1 for name in _names(p)] for p in all_participants]
    shares = fair_shares([sum(name_sizes) for name_sizes in sizes], most)
    return tuple(
        _with_names(p, sum(1 for used in accumulate(name_sizes) if used <= share))
        for p, name_sizes, share in zip(all_participants, sizes, shares, strict=True)
    )


def _names(participant: ParticipantStatus) -> tuple[str, ...]:
    return (*participant.publishes, *participant.subscribes, *participant.services)


def _with_names(participant: ParticipantStatus, count: int) -> ParticipantStatus:
    """A participant with the first of its names."""
    subscribed = max(count - len(participant.publishes), 0)
    return msgspec.structs.replace(
        participant,
        publishes=participant.publishes[:count],
        subscribes=participant.subscribes[:subscribed],
        services=participant.services[: max(subscribed - len(participant.subscribes), 0)],
        left_out=participant.left_out + len(_names(participant)) - count,
    )


def fair_shares(wanted: Sequence[int], most: int) -> list[int]:
    """How much each gets of ``most``: what it wants, or as much as all others that want more."""
    shares, remaining = [0] * len(wanted), most
    by_size = sorted(range(len(wanted)), key=wanted.__getitem__)
    for served, index in enumerate(by_size):
        shares[index] = min(wanted[index], remaining // (len(wanted) - served))
        remaining -= shares[index]
    return shares


def _cut(node: EndpointStatus, share: int) -> EndpointStatus:
    """A node with the first items of its lists, as many as fit."""
    lists: dict[str, tuple[ListEntry, ...]] = {}
    left_out = 0
    for name in _LISTS:
        kept: list[ListEntry] = []
        for item in getattr(node, name):
            share -= _size(item)
            if share >= 0:
                kept.append(item)
            else:
                left_out += 1
        lists[name] = tuple(kept)
    return msgspec.structs.replace(node, **lists, left_out=left_out)


def _items(node: EndpointStatus) -> chain[ListEntry]:
    return chain.from_iterable(getattr(node, name) for name in _LISTS)


def _size(item: ListEntry) -> int:
    """Characters of an item as JSON, with what separates it from the next; about."""
    if isinstance(item, str):
        return len(json.dumps(item)) + 2
    texts = item.kind, item.name, item.caller_id, item.peer
    return CONNECTION_OVERHEAD + sum(len(json.dumps(text)) for text in texts)
