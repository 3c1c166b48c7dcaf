"""Gathering the facts for ``rosproxy doctor``: asks the proxy, the master and the nodes.

First the proxy (`AdminClient`), which knows its nodes and whether its ports can be reached; then
the master and nodes of ROS 1 (`graph_survey`). For ROS 2 it asks the participants on the networks
inside (`domain_survey`). The rules judge the facts.

It changes nothing, apart from the short-lived parameter by which the proxy has the master try its
ports (see `range_probe`). Names and addresses are tried from where it runs; that should be where
the proxy runs.
"""

import asyncio
from collections.abc import Callable

from msgspec.structs import replace

from rosproxy.admin.admin_client import AdminClient, AdminError
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.doctor.domain_survey import ask_participants
from rosproxy.doctor.facts import DoctorFacts, HeardParticipant, SystemState
from rosproxy.doctor.graph_survey import ask_graph
from rosproxy.net.addresses import is_loopback, parse_host_port
from rosproxy.net.resolver import resolve


async def collect(
    admin: AdminClient | None,
    master_uri: str = "",
    advertise_host: str = "",
    names: tuple[str, ...] = (),
    master_address: str | None = None,
) -> DoctorFacts:
    """Ask the proxy, the master, the nodes and the participants, and change nothing.

    Without ``admin`` no proxy is asked, as from an outside machine. ``master_uri``,
    ``advertise_host`` and ``master_address`` count where the proxy doesn't answer; the last is the
    IP address at which the master's host is reached, whatever its name leads to.
    """
    addresses = await resolve(advertise_host) if advertise_host else ()
    facts = DoctorFacts(
        advertise_host=advertise_host, advertised_addresses=tuple(addresses), names=names
    )
    if admin is None:
        return await ask_graph(facts, master_uri, master_address)
    try:
        return await _ask_proxy(facts, admin)
    except AdminError as error:
        facts = replace(facts, admin_error=str(error))
        return await ask_graph(facts, master_uri, master_address)


async def _ask_proxy(facts: DoctorFacts, admin: AdminClient) -> DoctorFacts:
    status = await asyncio.to_thread(admin.status)
    host = status.settings.advertise_host
    master = status.master
    addresses = tuple(await resolve(host)) if host else ()
    facts = replace(
        facts,
        admin=admin.url,
        status=status,
        advertise_host=host,
        advertised_addresses=addresses,
    )
    if status.domains:
        heard = await _survey(status)
        status = await asyncio.to_thread(admin.status)  # by now it has heard those just started
        facts = replace(facts, heard_participants=heard, status=status)
    address = master.address if master.pinned else None
    uri = master.uri if status.settings.for_ros1 else ""
    # The proxy tries its range meanwhile; each of the two may take some seconds.
    graph_task = asyncio.create_task(ask_graph(facts, uri, address))
    probe = None
    reason = ""
    try:
        probe = await asyncio.to_thread(admin.probe)
    except AdminError as error:
        reason = str(error)
    facts = replace(await graph_task, probe=probe, probe_error=reason)
    return replace(facts, is_all_local=_all_here(status))


def _all_here(status: ProxyStatus) -> bool:
    """Whether a proxy serves ROS 2 only, and outside has only peers on loopback."""
    peers = [peer for domain in status.domains for peer in domain.peers]
    hosts = [target.host if (target := parse_host_port(peer)) else peer for peer in peers]
    lan_relays = [domain.lan_relay for domain in status.domains if domain.lan_relay]
    return not status.settings.for_ros1 and not lan_relays and all(map(is_loopback, hosts))


async def collect_running(
    status: ProxyStatus, admin: str, choose: Callable[[SystemState], tuple[str, ...]]
) -> DoctorFacts:
    """The facts that may be asked again and again: of the master, of all nodes, and of some names.

    ``choose`` picks the names from what the master knows. The range is not tried, and only a few
    nodes are asked at once. Nodes also say how much they have counted (``getBusStats``).
    """
    host = status.settings.advertise_host
    master = status.master
    facts = DoctorFacts(
        admin=admin,
        status=status,
        advertise_host=host,
        advertised_addresses=tuple(await resolve(host)) if host else (),
    )
    uri = master.uri if status.settings.for_ros1 else ""
    return await ask_graph(facts, uri, master.address if master.pinned else None, choose)


async def _survey(status: ProxyStatus) -> tuple[HeardParticipant, ...]:
    """The participants on the networks inside, each one once."""
    domains = [domain.domain for domain in status.domains]
    networks = status.settings.inside_networks
    surveys = (asyncio.to_thread(ask_participants, network, domains) for network in networks)
    by_prefix = {p.guid_prefix: p for answers in await asyncio.gather(*surveys) for p in answers}
    return tuple(by_prefix.values())
