"""Read what a datagram announces about a participant and its readers and writers."""

from collections.abc import Iterable

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
from rosproxy.ros2.rewriting.discovery import Announcement
from rosproxy.shared.addresses import HostPort, is_loopback

LONGEST_LEASE_DURATION_S = 300.0
"""Upper bound in seconds for the lease duration that a participant announces."""
DEFAULT_LEASE_DURATION_S = 100.0
"""The lease duration in seconds of a participant that announces none (DDSI-RTPS 2.5, 9.6.3.2)."""
_UNKNOWN_DOMAIN = 0xFFFF_FFFF
"""The domain that Fast DDS announces if the domain is unknown."""
_PROTECTED = 0x01 | 0x02
"""Security attributes of a participant: whole messages are protected, or discovery is (DDS Security
1.1, 7.4.1.6)."""
_VALID = 0x8000_0000
"""The bit without which the security attributes have no meaning."""


def lease_duration(spdp: Announcement, datagram: bytes) -> float:
    """The lease duration of a participant in seconds, from 1 to LONGEST_LEASE_DURATION_S."""
    seconds = spdp.parameters.seconds(datagram, Pid.PARTICIPANT_LEASE_DURATION)
    return min(
        max(DEFAULT_LEASE_DURATION_S if seconds is None else seconds, 1.0), LONGEST_LEASE_DURATION_S
    )


def first_metatraffic(spdp: Announcement, datagram: bytes, address: str) -> HostPort | None:
    """The first metatraffic locator with this address; None if there is none."""
    locators = (
        locator
        for pid, locator in spdp.reached_at(datagram)
        if pid == Pid.METATRAFFIC_UNICAST_LOCATOR and locator.host == address
    )
    return next(locators, None)


def traits(spdp: Announcement, datagram: bytes, address: str) -> ParticipantTraits:
    """The traits of a participant; ``address`` is the source of its announcement."""
    domain = spdp.parameters.number(datagram, Pid.DOMAIN_ID)
    return ParticipantTraits(
        None if domain == _UNKNOWN_DOMAIN else domain,
        _security(spdp, datagram),
        _locator_fault(spdp, datagram, address),
    )


def note_endpoints(
    notes: EndpointNotes,
    participant: Participant,
    datagram: bytes,
    announcements: Iterable[Announcement],
) -> None:
    """Note the readers and writers that a participant announces. Raises RtpsError."""
    for announcement in announcements:
        kind = announcement.kind
        entity = announcement.endpoint(datagram)
        if kind is None or entity is None:
            continue
        topic = announcement.topic(datagram)
        type_name = announcement.parameters.text(datagram, Pid.TYPE_NAME) or ""
        qos = read_qos(datagram, announcement.parameters, kind is EndpointKind.WRITER)
        # Only the status and findings use these texts. A topic of ROS 2 has at most 255 bytes.
        endpoint = DdsEndpoint(kind, topic[:256], type_name[:256], qos)
        notes.note(participant, entity, None if announcement.ended else endpoint)


def _security(spdp: Announcement, datagram: bytes) -> DdsSecurity:
    """How DDS Security affects a participant: authentication of others, protection of discovery.

    SPDP has parameters for what DDS Security protects (DDS Security 1.1, 7.4.1.4 and 7.4.1.6).
    """
    attributes = spdp.parameters.number(datagram, Pid.PARTICIPANT_SECURITY_INFO)
    if attributes is not None and attributes & _VALID and attributes & _PROTECTED:
        return DdsSecurity.PROTECTED
    tokens = spdp.parameters.all(Pid.IDENTITY_TOKEN, Pid.PERMISSIONS_TOKEN)
    return DdsSecurity.AUTHENTICATED if tokens or attributes else DdsSecurity.NONE


def _locator_fault(spdp: Announcement, datagram: bytes, address: str) -> LocatorFault:
    """Why the proxy can't pass datagrams to a participant at an address; NO if it can.

    Metatraffic locators are checked before the locators for user data.
    """
    for pid in (Pid.METATRAFFIC_UNICAST_LOCATOR, Pid.DEFAULT_UNICAST_LOCATOR):
        locators = [read_locator(datagram, spdp.parameters, p) for p in spdp.parameters.all(pid)]
        hosts = {locator.host_port.host for locator in locators if locator and locator.host_port}
        if address in hosts:
            continue
        if hosts:
            all_loopback = all(map(is_loopback, hosts))
            return LocatorFault.LOOPBACK if all_loopback else LocatorFault.ELSEWHERE
        if any(loc.kind in (LocatorKind.TCP_V4, LocatorKind.TCP_V6) for loc in locators if loc):
            return LocatorFault.TCP
        # Default locators are optional: a reader may have separate ones (DDSI-RTPS 2.5, 8.5.3.2).
        if locators or pid == Pid.METATRAFFIC_UNICAST_LOCATOR:
            return LocatorFault.MISSING
    return LocatorFault.NO
