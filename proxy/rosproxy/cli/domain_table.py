"""The domains of ROS 2 in ``rosproxy status``: a line and a table of participants for each."""

from collections.abc import Iterator

from rosproxy.shared.documents import status_document as document
from rosproxy.shared.output.tables import GAP, besides_first, table
from rosproxy.shared.output.text import clean, listed, plural, size, wrap

HEADING = ("PARTICIPANT", "SIDE", "ADDRESS", "VENDOR", "PUB", "SUB", "SRV", "PORTS", "IN", "RATE")
MOST_LINES = 3
"""Lines for the topics of a participant at most; the same for services and ports."""
INDENT = "    "
KERNEL = "kernel"


def domain_lines(domain: document.DomainStatus, columns: int) -> Iterator[str]:
    """The lines for a domain and its participants, with topics and services."""
    yield ""
    yield from wrap(_summary(domain), columns, INDENT)
    participants = [*domain.inside, *domain.outside]
    if not participants:
        yield "No participant has been heard yet."
        return
    # If there are participants inside, a participant outside should send to the range. Until it
    # does, its side has a question mark.
    unheard = "outside?" if domain.inside else "outside"
    sides = ["inside"] * len(domain.inside)
    sides += ["outside" if p.proven else unheard for p in domain.outside]
    rows = [HEADING, *(_row(p, side) for p, side in zip(participants, sides, strict=True))]
    heading, *lines = table(rows, 4, max(columns - besides_first(rows), len(HEADING[0])))
    yield heading
    for participant, line in zip(participants, lines, strict=True):
        yield line
        yield from _details(participant, columns, domain.data_plane)


def _summary(domain: document.DomainStatus) -> str:
    targets = [f"peers {listed(map(clean, domain.peers))}"] if domain.peers else []
    targets += [f"LAN relay {clean(domain.lan_relay)}"] if domain.lan_relay else []
    announced_to = (
        "; ".join(targets)
        or "no peer and no LAN relay is set, so inside is announced to no host outside"
    )
    ports = f"{domain.ports_used} ports used, {domain.ports_free} free"
    lost = domain.lost + domain.overflowed
    trouble = f"; {domain.dropped} datagrams refused, {lost} lost" if domain.dropped or lost else ""
    plane = f"; user data {_plane(domain.data_plane)}" if domain.data_plane else ""
    discovery = clean(domain.discovery)
    return (
        f"domain {domain.domain}: {announced_to}; discovery at {discovery}; {ports}{plane}{trouble}"
    )


def _plane(plane: document.DataPlaneStatus) -> str:
    if plane.plane == KERNEL:
        return "forwarded by the kernel"
    return f"relayed by the proxy ({clean(plane.reason)})"


def _row(participant: document.ParticipantStatus, side: str) -> tuple[str, ...]:
    return (
        clean(participant.guid_prefix),
        side,
        clean(participant.address),
        clean(participant.vendor),
        *(
            str(len(names))
            for names in (participant.publishes, participant.subscribes, participant.services)
        ),
        str(len(participant.leases)) if participant.leases else "-",
        size(sum(lease.bytes + lease.kernel_bytes for lease in participant.leases))
        if participant.leases
        else "-",
        f"{size(sum(lease.rate for lease in participant.leases))}/s" if participant.leases else "-",
    )


def _details(
    participant: document.ParticipantStatus, columns: int, plane: document.DataPlaneStatus | None
) -> Iterator[str]:
    types = {t.name: t.type for t in participant.types}

    def typed(names: tuple[str, ...]) -> str:
        return GAP.join(clean(f"{name} {types.get(name, '')}".strip()) for name in names)

    ports = (f"{lease.port} to {clean(lease.where)}" for lease in participant.leases)
    for label, text in (
        ("nodes", GAP.join(map(clean, participant.nodes))),
        ("publishes", typed(participant.publishes)),
        ("subscribes", typed(participant.subscribes)),
        ("services", GAP.join(map(clean, participant.services))),
        ("ports", GAP.join(ports)),
        ("kernel", _kernel(participant) if plane and plane.plane == KERNEL else ""),
        ("not shown", plural(participant.left_out, "name") if participant.left_out else ""),
    ):
        lead = f"{INDENT}{label:<11}"
        yield from wrap(text, columns, " " * len(lead), lead, MOST_LINES)


def _kernel(participant: document.ParticipantStatus) -> str:
    """What the kernel forwards to a participant, and the reason for each port without a forward."""
    forwarded = [lease for lease in participant.leases if lease.plane == KERNEL]
    ports = listed(str(lease.port) for lease in forwarded)
    datagrams = plural(sum(lease.kernel_datagrams for lease in forwarded), "datagram")
    traffic = f"{datagrams}, {size(sum(lease.kernel_bytes for lease in forwarded))} as IP packets"
    relayed = [
        lease for lease in participant.leases if lease.kind == "data" and lease.plane != KERNEL
    ]
    notes = [f"{traffic}, to {ports}"] if forwarded else []
    notes += [f"{lease.port} not used: {clean(lease.reason)}" for lease in relayed]
    return "; ".join(notes)
