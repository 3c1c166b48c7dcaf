"""Who may use the proxy as its master: nodes inside, and of those the ones that were selected.

ROS 1 knows no identity but the address that a call comes from. Without an operator every address
of the inside networks may; an operator names the addresses that it has selected (``POST
/containers``), and then only these may, wherever they lie. Until it has named them for the first
time after a start, the networks count: a proxy that is started again while its operator is away
serves whomever it served.
"""

from collections.abc import Collection, Sequence
from enum import Enum

from rosproxy.fixes import how_to_in_a_sentence
from rosproxy.net.addresses import Network, is_inside


class ClientKind(Enum):
    """What an address is to the proxy; the value is the word for it in metrics."""

    ADMITTED = "admitted"
    OUTSIDE = "outside"
    UNSELECTED = "unselected"


def client_kind(
    address: str, networks: Sequence[Network], selected: Collection[str] | None
) -> ClientKind:
    """What an address is, given the inside networks and the selected addresses; None: not told."""
    if selected is not None and address in selected:
        return ClientKind.ADMITTED
    if not is_inside(address, networks):
        return ClientKind.OUTSIDE
    return ClientKind.ADMITTED if selected is None else ClientKind.UNSELECTED


def refusal(address: str, kind: ClientKind, networks: Sequence[Network]) -> str:
    """What somebody is told, in one line, who may not use the proxy as its master."""
    if kind is ClientKind.UNSELECTED:
        return (
            f"rosproxy: {address} is not selected to use this proxy as its master. "
            + how_to_in_a_sentence("selected")
        )
    inside = ", ".join(map(str, networks)) or "none"
    return (
        f"rosproxy: {address} is not in an inside network ({inside}). Only inside nodes may use "
        f"this proxy as their master. {how_to_in_a_sentence('inside network')}, or use the real "
        "master"
    )
