"""Who forwards user data of ROS 2, the proxy or the kernel: for ``/status``, and as metrics."""

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.admin import status_document as document
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.ros2.discovery.data_leases import DataLeases
from rosproxy.ros2.registry.participants import Lease, LeaseKind


@dataclass(eq=False)
class DomainPlane(Collector):
    """The kernel's plane, and the leases that it may forward, of all domains."""

    _plane: KernelPlane
    _forwarded: DataLeases

    def status(self) -> document.DataPlaneStatus:
        """How user data is forwarded."""
        return msgspec.convert(self._plane.status(), document.DataPlaneStatus)

    def locator(self, lease: Lease) -> document.LocatorStatus:
        """A port, where it leads, and who forwards what arrives there."""
        is_read = lease.kind is LeaseKind.METATRAFFIC
        status = document.LocatorStatus(
            lease.port,
            str(lease.target),
            lease.kind.value,
            lease.datagrams,
            lease.bytes,
            lease.rate,
            self._plane.user_plane,
            "it is read and rewritten" if is_read else "the kernel forwards to inside alone",
        )
        forwarded = self._forwarded.by_port.get(lease.port)
        if forwarded is None:
            return status
        kernel = self._plane.status_of(forwarded)
        return msgspec.structs.replace(
            status,
            plane=kernel["plane"],
            reason=kernel["reason"],
            kernel_datagrams=kernel["received_packets"],
            kernel_bytes=kernel["received"],
            rate=lease.rate + kernel["received_rate"],
        )

    def collect(self) -> Iterator[Metric]:
        """What the kernel forwards, of all domains."""
        text = "Whether the kernel forwards user data of ROS 2."
        usable = self._plane.syncer.usable
        yield GaugeMetricFamily("rosproxy_ros2_kernel_plane", text, value=usable)
        text = "Datagrams of user data that the kernel forwarded to participants inside."
        packets = self._plane.total.packets
        yield CounterMetricFamily("rosproxy_ros2_kernel_datagrams", text, value=packets)
        text = "Bytes of these as IP packets, headers included."
        received = self._plane.total.received
        yield CounterMetricFamily("rosproxy_ros2_kernel_bytes", text, value=received)
