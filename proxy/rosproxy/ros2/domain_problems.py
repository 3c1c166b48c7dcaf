"""The problems that prevent discovery or matching in a domain, with cause and fix.

``rosproxy doctor`` reports the problems when it runs. The proxy reports a problem in its log and in
``rosproxy status``, when the problem appears. Each participant has at most one problem, the first
cause, because further problems follow from it.
"""

from collections.abc import Iterator

import msgspec
from msgspec.structs import replace

from rosproxy.forwarding.buffer_sizes import UDP_RECEIVE_BUFFER_BYTES
from rosproxy.ros2.protocol.rtps import CYCLONE_DDS, FAST_DDS
from rosproxy.ros2.registry.participants import VENDORS, DdsSecurity, LocatorFault, ShortageKind
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    MismatchStatus,
    ParticipantStatus,
)
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import plural


class DomainProblem(msgspec.Struct, frozen=True):
    """A problem: the ``check`` that found it, the participant or name (``subject``), and the fix.

    ``grave`` means that participants certainly do not communicate. ``owner`` is the address of the
    participant; for a pair, it is the address inside.
    """

    check: str
    subject: str
    text: str
    fix: str
    grave: bool = True
    owner: str = ""


LEAST_OVERFLOWED = 60
"""Datagrams that the kernel drops in a minute, from which on they are a problem. DDS sends single
lost datagrams again."""
_FAST_DDS_NAME = VENDORS[FAST_DDS]
_CYCLONE_DDS_NAME = VENDORS[CYCLONE_DDS]
_LOCATOR_FAULTS: dict[str, tuple[str, str]] = {
    LocatorFault.TCP: (
        "receives by TCP only, and the proxy passes on UDP only",
        "where the participant runs: unset FASTDDS_BUILTIN_TRANSPORTS (LARGE_DATA is TCP), or add "
        "the transport UDPv4 to the profile",
    ),
    LocatorFault.LOOPBACK: (
        "announces only loopback addresses. Other machines reach only themselves at such addresses",
        "where the participant runs: set ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET, unset "
        "ROS_LOCALHOST_ONLY, and remove loopback from CYCLONEDDS_URI or the interface list. If "
        "the participant started before its network was up, restart it",
    ),
    LocatorFault.ELSEWHERE: (
        "does not announce the address from which it sends",
        "where the participant runs: use a network that the proxy shares (interface list of the "
        "profile, or CYCLONEDDS_URI), without NAT between participant and proxy",
    ),
    LocatorFault.MISSING: (
        "announces no UDP address",
        "where the participant runs: add the transport UDPv4 to the profile",
    ),
}
_SHORTAGE_FIXES = {
    ShortageKind.BOUND.value: (
        "where the participant runs: use fewer addresses (interface list of the profile, or "
        "CYCLONEDDS_URI), fewer readers and writers with separate ports (unique network flows), or "
        "several processes. A larger range does not help"
    ),
}
_DEFAULT_FIX = "set the same {policy} on both sides"
_FIXES = {
    "type": "use the same type in both programs, or remap the name in one of them",
    "reliability": "make the publisher RELIABLE, or the subscription BEST_EFFORT",
    "durability": "make the publisher TRANSIENT_LOCAL (latched), or the subscription VOLATILE",
    "deadline": "set a shorter deadline in the publisher, or a longer deadline in the subscription",
    "liveliness lease duration": (
        "set a shorter lease duration in the publisher, or a longer one in the subscription"
    ),
    "data representation": "use XCDR version 1 in both programs, as ROS 2 does",
}


def domain_problems(domain: DomainStatus) -> Iterator[DomainProblem]:
    """Yield the problems of a domain, in the order in which to fix them."""
    yield from (problem for _, problem in _participant_problems(domain))
    yield from (problem for _, problem in mismatch_problems(domain))
    yield from _overflow(domain)
    if domain.mismatches_left_out:
        text = f"{plural(domain.mismatches_left_out, 'more pair')} of endpoints don't match"
        yield DomainProblem(
            "qos",
            f"domain {domain.domain}",
            text,
            "first correct the pairs that other findings name",
        )
    if domain.not_compared:
        # No number in this text: the number would change with each check, and `DomainWatch` would
        # report each change.
        text = "some pairs of a reader and a writer are not compared: the domain has too many"
        fix = (
            f"to see the readers and writers of each address, {how_to('status')}. Stop programs "
            "that have thousands. A domain of hundreds of nodes may have so many without a fault"
        )
        yield DomainProblem("qos", f"domain {domain.domain}", text, fix, grave=False)


def _overflow(domain: DomainStatus) -> Iterator[DomainProblem]:
    """Yield the problem that the kernel drops datagrams, unless these are a few.

    The text has no count, because `DomainWatch` would report each change.
    """
    if domain.overflowed_recently < LEAST_OVERFLOWED:
        return
    text = (
        "datagrams arrive faster than the proxy reads them, and the kernel drops some, because a "
        f"receive buffer has {domain.receive_buffer // 1024} KiB. Large messages are late or lost"
    )
    fixes = []
    if domain.receive_buffer < UDP_RECEIVE_BUFFER_BYTES:
        sysctl = f"sysctl -w net.core.rmem_max={UDP_RECEIVE_BUFFER_BYTES}"
        fixes.append(f"run {sysctl} on the host of the proxy, and restart the proxy")
    if domain.data_plane is not None and domain.data_plane.plane != "kernel":
        fixes.append(how_to("kernel plane"))
    fix = "; or ".join(fixes) or "send smaller or fewer messages, or give the host more processors"
    yield DomainProblem("buffer", f"domain {domain.domain}", text, fix, grave=False)


def mismatch_problems(domain: DomainStatus) -> Iterator[tuple[MismatchStatus, DomainProblem]]:
    """Yield each mismatch with its problem.

    A pair is left out if one of the participants has a grave problem.
    """
    hindered = {p.guid_prefix for p, problem in _participant_problems(domain) if problem.grave}
    labels = {p.guid_prefix: participant_label(p, True) for p in domain.inside}
    labels |= {p.guid_prefix: participant_label(p, False) for p in domain.outside}
    addresses = {p.guid_prefix: p.address for p in domain.inside}
    for pair in domain.mismatches:
        if not hindered & {pair.writer, pair.reader}:
            problem = _mismatch(pair, labels.get(pair.writer, ""), labels.get(pair.reader, ""))
            owner = addresses.get(pair.writer, addresses.get(pair.reader, ""))
            yield pair, replace(problem, owner=owner)


def participant_label(participant: ParticipantStatus, is_inside: bool) -> str:
    """The address, implementation and side of a participant, for texts about its GUID prefix."""
    return (
        f"at {participant.address} ({participant.vendor}, {'inside' if is_inside else 'outside'})"
    )


def _participant_problems(
    domain: DomainStatus,
) -> Iterator[tuple[ParticipantStatus, DomainProblem]]:
    for side in (domain.inside, domain.outside):
        for participant in side:
            problem = next(_problems(participant, domain, side is domain.inside), None)
            if problem:
                yield participant, replace(problem, owner=participant.address)


def _problems(
    participant: ParticipantStatus, domain: DomainStatus, is_inside: bool
) -> Iterator[DomainProblem]:
    """Yield the problems of a participant, the first cause first."""
    label = f"participant {participant_label(participant, is_inside)}"
    if participant.domain is not None and participant.domain != domain.domain:
        text = (
            f"{label}: announces domain {participant.domain}, but was heard in domain "
            f"{domain.domain}"
        )
        fix = (
            f"set ROS_DOMAIN_ID={domain.domain} for the participant, or "
            f"{how_to('domain', domain=participant.domain)}"
        )
        yield DomainProblem("domain", participant.guid_prefix, text, fix)
    fault = _LOCATOR_FAULTS.get(participant.locator_fault)
    if fault:
        yield DomainProblem("transport", participant.guid_prefix, f"{label}: {fault[0]}", fault[1])
    # The proxy replaces locators in the SEDP of participants outside only with the direction both.
    if is_inside or domain.direction == "both":
        yield from _security(participant, label, is_inside)
    if participant.problem:
        fix = _SHORTAGE_FIXES.get(participant.shortage) or how_to("larger range")
        yield DomainProblem(
            "ports", participant.guid_prefix, f"{label}: {participant.problem}", fix
        )
    # A participant outside sends to the range only if there are participants inside.
    if domain.inside and not participant.proven:
        text = f"{label}: no datagram from this participant has arrived at the ports of the range"
        fix = (
            f"{how_to('publish for UDP')}, and let firewalls accept UDP from the participant to "
            f"{domain.discovery.rpartition(':')[0]}"
        )
        yield DomainProblem("reached", participant.guid_prefix, text, fix, grave=False)


def _security(
    participant: ParticipantStatus, label: str, is_inside: bool
) -> Iterator[DomainProblem]:
    """Yield the problem of a participant whose discovery is protected: the proxy can't change it.

    Fast DDS repeats its locators in the announcement of each reader and writer. Cyclone DDS has
    locators only in the announcement of the participant, which is never protected.
    """
    if participant.security != DdsSecurity.PROTECTED or participant.vendor == _CYCLONE_DDS_NAME:
        return
    text = f"{label}: DDS Security protects its discovery, so the proxy can't replace the "
    side = "outside" if is_inside else "inside"
    text += f"addresses of its readers and writers. Datagrams from {side} do not reach these"
    fix = "set discovery_protection_kind and rtps_protection_kind to NONE in the governance; or "
    fix += "set ROS_SECURITY_ENABLE=false"
    if not is_inside:
        fix += f"; or give participants inside a route outwards, and {how_to('direction out')}"
    # Not grave for other vendors: if these do not repeat the locators, no connection fails.
    yield DomainProblem(
        "security", participant.guid_prefix, text, fix, grave=participant.vendor == _FAST_DDS_NAME
    )


def _mismatch(pair: MismatchStatus, writer: str, reader: str) -> DomainProblem:
    sides = ("publisher", "subscription") if pair.kind == "topic" else ("writer", "reader")
    text = (
        f"{pair.policy} differs: the {sides[0]} {pair.writer} {writer} offers {pair.offered}, "
        f"the {sides[1]} {pair.reader} {reader} requests {pair.requested}"
    )
    fix = _FIXES.get(pair.policy, _DEFAULT_FIX.format(policy=pair.policy))
    check = "type" if pair.policy == "type" else "qos"
    return DomainProblem(check, f"{pair.kind} {pair.name}", text, fix)
