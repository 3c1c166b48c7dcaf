"""Gathers the facts for ``rosproxy doctor``.

The doctor first asks the proxy (`AdminClient`) for its nodes, and whether outside reaches its
ports. Then the doctor asks the master and the nodes of ROS 1 (`graph_survey`), and for ROS 2
the participants on the networks inside (`domain_survey`). The rules judge the facts.

The doctor changes nothing, except for a short-lived parameter at the master. With this parameter,
the proxy has the master try the ports of the range (`range_probe`). The doctor resolves names
and tries addresses from where the doctor itself runs. It should run where the proxy runs.
"""

import asyncio
from collections.abc import Callable

from msgspec.structs import replace

from rosproxy.doctor.domain_survey import ask_participants
from rosproxy.doctor.facts import DoctorFacts, HeardParticipant, SystemState
from rosproxy.doctor.graph_survey import ask_graph
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.http.admin_client import AdminClient, AdminError
from rosproxy.shared.machine.resolver import resolve


async def collect(
    admin: AdminClient | None,
    master_uri: str = "",
    advertise_host: str = "",
    names: tuple[str, ...] = (),
    master_address: str | None = None,
) -> DoctorFacts:
    """Ask the proxy, the master, the nodes and the participants.

    Without ``admin`` the doctor asks no proxy, as on an outside machine. ``names``: the nodes,
    topics and services that the user asks for. ``master_uri``, ``advertise_host`` and
    ``master_address`` count only without an answer of the proxy. ``master_address``: the IP address
    of the master's host, to use instead of the host name.
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
        # Again: meanwhile the proxy has heard participants that started just before.
        status = await asyncio.to_thread(admin.status)
        facts = replace(facts, heard_participants=heard, status=status)
    address = master.address if master.pinned else None
    uri = master.uri if status.settings.for_ros1 else ""
    # At the same time, the proxy tries the range; both may take some seconds.
    graph_task = asyncio.create_task(ask_graph(facts, uri, address))
    probe = None
    reason = ""
    try:
        probe = await asyncio.to_thread(admin.probe)
    except AdminError as error:
        reason = str(error)
    return replace(await graph_task, probe=probe, probe_error=reason)


async def collect_running(
    status: ProxyStatus, admin: str, choose: Callable[[SystemState], tuple[str, ...]]
) -> DoctorFacts:
    """Gather the facts for the live page, which may ask repeatedly.

    ``choose`` picks the names to examine from the state of the master. ``admin``: the URL of the
    admin endpoint. The doctor does not try the range, and asks only a few nodes at once.
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
    """The participants on all networks inside, without duplicates."""
    domains = [domain.domain for domain in status.domains]
    networks = status.settings.inside_networks
    surveys = (asyncio.to_thread(ask_participants, network, domains) for network in networks)
    by_prefix = {p.guid_prefix: p for answers in await asyncio.gather(*surveys) for p in answers}
    return tuple(by_prefix.values())
