"""What a datagram announces of the participant that sends it."""

from collections.abc import Iterable

from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.ros2.protocol.locators import LocatorKind, read_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.qos import read_qos
from rosproxy.ros2.registry.participants import (
    DdsEndpoint,
    DdsSecurity,
    EndpointKind,
    EndpointNotes,
    LocatorFault,
    Participant,
    ParticipantTraits,
)
from rosproxy.ros2.rewriting.discovery import Announcement, read_discovery

LONGEST_LEASE = 300.0
"""Seconds after which a participant counts as gone that is not heard, whatever it says itself."""
USUAL_LEASE = 100.0
"""The same where it says nothing (DDSI-RTPS 2.5, 9.6.3.2)."""
_UNKNOWN_DOMAIN = 0xFFFF_FFFF
"""What Fast DDS calls a domain that it does not know."""
_PROTECTED = 0x01 | 0x02
"""Of a participant's security attributes: whole messages are protected, or discovery is
(DDS Security 1.1, 7.4.1.6)."""
_VALID = 0x8000_0000
"""The attributes mean anything only with this bit."""


def lease_duration(told: Announcement, datagram: bytes) -> float:
    """For how many seconds a participant is there that is not heard again, within bounds."""
    said = told.held.seconds(datagram, Pid.PARTICIPANT_LEASE_DURATION)
    return min(max(USUAL_LEASE if said is None else said, 1.0), LONGEST_LEASE)


def first_metatraffic(told: Announcement, datagram: bytes, address: str) -> HostPort | None:
    """Where its discovery is reached at an address; None if not there."""
    reached = (
        where
        for pid, where in told.reached_at(datagram)
        if pid == Pid.METATRAFFIC_UNICAST_LOCATOR and where.host == address
    )
    return next(reached, None)


def traits(told: Announcement, datagram: bytes, address: str) -> ParticipantTraits:
    """What a participant at an address says of itself that may keep others from meeting it."""
    domain = told.held.number(datagram, Pid.DOMAIN_ID)
    return ParticipantTraits(
        None if domain == _UNKNOWN_DOMAIN else domain,
        _security(told, datagram),
        _locator_fault(told, datagram, address),
    )


def note_endpoints(
    notes: EndpointNotes, participant: Participant, datagram: bytes, found: Iterable[Announcement]
) -> None:
    """Take in which readers and writers a participant announces. Raises RtpsError."""
    for one in found:
        kind, entity = one.kind, one.endpoint(datagram)
        if kind is None or entity is None:
            continue
        topic, type_name = one.topic(datagram), one.held.text(datagram, Pid.TYPE_NAME) or ""
        qos = read_qos(datagram, one.held, kind is EndpointKind.WRITER)
        endpoint = DdsEndpoint(kind, topic[:256], type_name[:256], qos)
        notes.note(participant, entity, None if one.ended else endpoint)


def _security(told: Announcement, datagram: bytes) -> DdsSecurity:
    """Whether a participant authenticates others, and whether its discovery can be read.

    What DDS Security protects SPDP tells by parameters of its own (1.1, 7.4.1.4 and 7.4.1.6).
    """
    attributes = told.held.number(datagram, Pid.PARTICIPANT_SECURITY_INFO)
    if attributes is not None and attributes & _VALID and attributes & _PROTECTED:
        return DdsSecurity.PROTECTED
    tokens = told.held.all(Pid.IDENTITY_TOKEN, Pid.PERMISSIONS_TOKEN)
    return DdsSecurity.AUTHENTICATED if tokens or attributes else DdsSecurity.NONE


def _locator_fault(told: Announcement, datagram: bytes, address: str) -> LocatorFault:
    """Why nothing can be passed on to a participant at an address; the first reason."""
    for pid in (Pid.METATRAFFIC_UNICAST_LOCATOR, Pid.DEFAULT_UNICAST_LOCATOR):
        found = [read_locator(datagram, told.held, one) for one in told.held.all(pid)]
        hosts = {one.where.host for one in found if one and one.where}
        if address in hosts:
            continue
        if hosts:
            alone = all(map(is_loopback, hosts))
            return LocatorFault.LOOPBACK if alone else LocatorFault.ELSEWHERE
        if any(one.kind in (LocatorKind.TCP_V4, LocatorKind.TCP_V6) for one in found if one):
            return LocatorFault.TCP
        if found or pid == Pid.METATRAFFIC_UNICAST_LOCATOR:
            return LocatorFault.MISSING
    return LocatorFault.NO


def next_number(announcement: bytes) -> int:
    """The number that comes after that of a participant's announcement. Raises RtpsError."""
    told = read_discovery(announcement).of_participant
    return told.sample.sequence + 1 if told else 1
