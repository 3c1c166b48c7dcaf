"""The domains of ROS 2 in ``rosproxy status``: a line for each, and its participants in a table."""

from collections.abc import Iterator

from rosproxy.admin import status_document as document
from rosproxy.telemetry.tables import GAP, besides_first, table
from rosproxy.telemetry.text import clean, listed, plural, size, wrap

HEADING = ("PARTICIPANT", "SIDE", "ADDRESS", "VENDOR", "PUB", "SUB", "SRV", "PORTS", "IN", "RATE")
MOST_LINES = 3
"""Lines that the topics or services of a participant may take, each."""
INDENT = "    "
KERNEL = "kernel"


def domain_lines(domain: document.DomainStatus, columns: int) -> Iterator[str]:
    """A domain and its participants, with what they publish and serve."""
    yield ""
    yield from wrap(_summary(domain), columns, INDENT)
    everybody = [*domain.inside, *domain.outside]
    if not everybody:
        yield "No participant has been heard yet."
        return
    sides = ["inside"] * len(domain.inside) + ["outside"] * len(domain.outside)
    rows = [HEADING, *(_row(one, side) for one, side in zip(everybody, sides, strict=True))]
    heading, *lines = table(rows, 4, max(columns - besides_first(rows), len(HEADING[0])))
    yield heading
    for one, line in zip(everybody, lines, strict=True):
        yield line
        yield from _details(one, columns, domain.data_plane)


def _summary(domain: document.DomainStatus) -> str:
    told = [f"peers {listed(map(clean, domain.peers))}"] if domain.peers else []
    told += [f"ear {clean(domain.ear)}"] if domain.ear else []
    found = "; ".join(told) or "neither peers nor an ear: outside is told of nobody"
    ports = f"{domain.ports_used} ports used, {domain.ports_free} free"
    lost = f"; {domain.dropped} datagrams refused, {domain.lost} lost"
    trouble = lost if domain.dropped or domain.lost else ""
    plane = f"; user data {_plane(domain.data_plane)}" if domain.data_plane else ""
    at = clean(domain.discovery)
    return f"domain {domain.domain}: {found}; found at {at}; {ports}{plane}{trouble}"


def _plane(plane: document.DataPlaneStatus) -> str:
    if plane.plane == KERNEL:
        return "forwarded by the kernel"
    return f"relayed by the proxy ({clean(plane.reason)})"


def _row(one: document.ParticipantStatus, side: str) -> tuple[str, ...]:
    return (
        clean(one.guid_prefix),
        side if one.proven else f"{side}?",
        clean(one.address),
        clean(one.vendor),
        *(str(len(names)) for names in (one.publishes, one.subscribes, one.services)),
        str(len(one.leases)) if one.leases else "-",
        size(sum(lease.bytes + lease.kernel_bytes for lease in one.leases)) if one.leases else "-",
        f"{size(sum(lease.rate for lease in one.leases))}/s" if one.leases else "-",
    )


def _details(
    one: document.ParticipantStatus, columns: int, plane: document.DataPlaneStatus | None
) -> Iterator[str]:
    types = {each.name: each.type for each in one.types}

    def typed(names: tuple[str, ...]) -> str:
        return GAP.join(clean(f"{name} {types.get(name, '')}".strip()) for name in names)

    ports = (f"{lease.port} to {clean(lease.where)}" for lease in one.leases)
    for word, text in (
        ("publishes", typed(one.publishes)),
        ("subscribes", typed(one.subscribes)),
        ("services", GAP.join(map(clean, one.services))),
        ("ports", GAP.join(ports)),
        ("kernel", _kernel(one) if plane and plane.plane == KERNEL else ""),
        ("not shown", plural(one.left_out, "name") if one.left_out else ""),
    ):
        lead = f"{INDENT}{word:<11}"
        yield from wrap(text, columns, " " * len(lead), lead, MOST_LINES)


def _kernel(one: document.ParticipantStatus) -> str:
    """What the kernel forwards to a participant; which user data it does not, and why."""
    forwarded = [lease for lease in one.leases if lease.plane == KERNEL]
    ports = listed(str(lease.port) for lease in forwarded)
    datagrams = plural(sum(lease.kernel_datagrams for lease in forwarded), "datagram")
    moved = f"{datagrams}, {size(sum(lease.kernel_bytes for lease in forwarded))} as IP packets"
    kept = [lease for lease in one.leases if lease.kind == "data" and lease.plane != KERNEL]
    told = [f"{moved}, to {ports}"] if forwarded else []
    told += [f"{lease.port} not used: {clean(lease.reason)}" for lease in kept]
    return "; ".join(told)
