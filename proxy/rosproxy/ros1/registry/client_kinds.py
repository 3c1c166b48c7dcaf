"""Which nodes may use the proxy as the master: nodes inside, or the selected nodes.

ROS 1 has no identity but the address from which a call comes. Without an operator, every address in
the inside networks may use the proxy. An operator names the selected addresses (``POST
/containers``). From then on only these addresses may use the proxy, in any network. Until the first
such report after a start, the inside networks count. So a proxy that starts without an operator
serves the same nodes as before.
"""

from collections.abc import Collection, Sequence
from enum import Enum

from rosproxy.shared.addresses import Network, is_inside
from rosproxy.shared.fixes import how_to_in_a_sentence


class ClientKind(Enum):
    """How the proxy treats an address; the value is the word for this in metrics."""

    ADMITTED = "admitted"
    OUTSIDE = "outside"
    UNSELECTED = "unselected"


def client_kind(
    address: str, networks: Sequence[Network], selected: Collection[str] | None
) -> ClientKind:
    """The kind of an address; ``selected`` is None if no operator has named addresses yet."""
    if selected is not None and address in selected:
        return ClientKind.ADMITTED
    if not is_inside(address, networks):
        return ClientKind.OUTSIDE
    return ClientKind.ADMITTED if selected is None else ClientKind.UNSELECTED


def refusal(address: str, kind: ClientKind, networks: Sequence[Network]) -> str:
    """Why an address may not use the proxy as the master, and what to do, in a line."""
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
