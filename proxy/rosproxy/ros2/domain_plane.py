"""How user data of ROS 2 is forwarded, by the proxy or the kernel: for ``/status`` and metrics."""

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.ros2.ports.kernel_ports import KernelPorts
from rosproxy.ros2.registry.participants import (
    InsideParticipant,
    Participant,
    PortMapping,
    TrafficKind,
)
from rosproxy.shared.documents import status_document as document


@dataclass(eq=False)
class DomainPlane(Collector):
    """The kernel plane, and the ports of all domains that the kernel may forward."""

    _plane: KernelPlane
    _forwarded: KernelPorts

    def status(self) -> document.DataPlaneStatus:
        """How user data is forwarded."""
        return msgspec.convert(self._plane.status(), document.DataPlaneStatus)

    def locator(self, participant: Participant, mapping: PortMapping) -> document.LocatorStatus:
        """The status of a port mapping of a participant."""
        status = document.LocatorStatus(
            mapping.port,
            str(mapping.target),
            mapping.kind.value,
            mapping.datagrams,
            mapping.bytes,
            mapping.rate,
            self._plane.user_plane,
            _reason(participant, mapping),
            user_datagrams=mapping.user_datagrams,
            user_rate=mapping.user_rate,
            user_datagram_rate=mapping.user_datagram_rate,
        )
        forwarded = self._forwarded.by_port.get(mapping.port)
        if forwarded is None:
            return status
        kernel = self._plane.status_of(forwarded)
        return msgspec.structs.replace(
            status,
            plane=kernel["plane"],
            reason=kernel["reason"],
            kernel_datagrams=kernel["received_packets"],
            kernel_bytes=kernel["received"],
            rate=mapping.rate + kernel["received_rate"],
            user_datagrams=mapping.user_datagrams + kernel["received_packets"],
            user_rate=mapping.user_rate + kernel["received_rate"],
            user_datagram_rate=mapping.user_datagram_rate + kernel["packet_rate"],
        )

    def collect(self) -> Iterator[Metric]:
        """The metrics of the kernel plane, for all domains."""
        text = "Whether the kernel forwards user data of ROS 2."
        usable = self._plane.syncer.usable
        yield GaugeMetricFamily("rosproxy_ros2_kernel_plane", text, value=usable)
        text = "Datagrams of user data that the kernel forwarded to participants inside."
        packets = self._plane.total.packets
        yield CounterMetricFamily("rosproxy_ros2_kernel_datagrams", text, value=packets)
        text = "Bytes of these datagrams as IP packets, headers included."
        received = self._plane.total.received
        yield CounterMetricFamily("rosproxy_ros2_kernel_bytes", text, value=received)


def _reason(participant: Participant, mapping: PortMapping) -> str:
    """Why the kernel may not forward a mapping that `KernelPorts` leaves out."""
    if mapping.kind is TrafficKind.METATRAFFIC:
        return "the proxy reads and rewrites discovery"
    if not isinstance(participant, InsideParticipant):
        return "the kernel forwards only to participants inside"
    if not participant.reads_discovery_at(mapping):
        return "another participant at the address may read discovery at this port"
    return f"{participant.vendor_name} may read discovery at this port"
