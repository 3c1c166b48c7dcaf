"""The self-check of a proxy: whether outside reaches the advertised host and the range.

1. At the start, the proxy resolves the advertised host.
2. After SETTLE_TIME_S, and once the master answers, the proxy tests whether outside reaches the
   range (`rosproxy.ros1.range_probe`). For ROS 2 the proxy tries by UDP: success proves that
   outside reaches the range, failure proves nothing.
3. Then the log says ``ready``, or reports the faults.

The log and ``rosproxy status`` report faults in the words of the doctor. The proxy tests again
until a test proves that outside reaches the range. After that, only a change causes another test:
the master was away or has another address, or the advertised host resolves to other addresses. A
fault blocks nothing: the proxy serves all connections that arrive. The field ``range_probe`` of the
status has the last result.
"""

import asyncio
import contextlib
import logging
from collections.abc import Iterable, Sequence
from typing import Any

from msgspec.structs import replace

from rosproxy.app.stacks import Stack
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import parse_authority
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.requests import RangeProbe
from rosproxy.shared.documents.setup_rules import (
    HOST,
    RANGE,
    advertised_host,
    is_all_here,
    probe_result,
    published_range,
)
from rosproxy.shared.documents.status_document import PortsStatus, RangeProbeStatus, to_json
from rosproxy.shared.machine.resolver import resolve
from rosproxy.shared.settings import Settings

log = logging.getLogger(__name__)

SETTLE_TIME_S = 3.0
"""Seconds between the start and the first test of the range. Nodes can register again meanwhile."""
RETRY_INTERVAL_S = 300.0
"""Seconds between tests, as long as no test has proven that outside reaches the range.

Tests are rare: if the call of the master does not arrive, one of the master's three threads waits
for two minutes.
"""
LEAST_INTERVAL_S = 30.0
"""Seconds between a change and the next test, so that many changes cause a single test."""


async def peer_addresses(settings: Settings) -> list[str]:
    """The addresses of the peers of ROS 2; the name of a peer whose name can't be resolved."""
    peers = settings.ros2_peer if settings.for_ros2 else ()
    resolved = [await resolve(peer.host) or [peer.host] for peer in peers]
    return [address for addresses in resolved for address in addresses]


class SelfCheck:
    """Tests the settings of a running proxy, and reports faults."""

    def __init__(self, runtime: Runtime, stacks: Sequence[Stack]) -> None:
        self._runtime = runtime
        self._stacks = stacks
        self._findings: dict[str, list[DoctorFinding]] = {}
        self._probing = asyncio.Lock()
        self._addresses: list[str] = []
        self._result: RangeProbeStatus | None = None
        self._tried_at = 0.0
        self._is_ready = False

    @property
    def findings(self) -> list[DoctorFinding]:
        """The current faults: findings of severity WARNING or ERROR."""
        return [finding for findings in self._findings.values() for finding in findings]

    @property
    def result(self) -> RangeProbeStatus | None:
        """The result of the last test of the range; None before the first test."""
        if self._result is None:
            return None
        return replace(self._result, age=round(self._runtime.now() - self._tried_at, 1))

    async def start(self) -> None:
        """Check the advertised host, and start to test the range in the background."""
        await self._look_at_host()
        self._runtime.tasks.spawn(self._keep_trying(), "trying the range from outside")

    async def probe(self, body: Any) -> dict[str, Any]:
        """``POST /probe``: test some ports of the range, and return the results as JSON."""
        return to_json(await self._try_range(or_fast=True))

    async def _keep_trying(self) -> None:
        await asyncio.sleep(SETTLE_TIME_S)
        for stack in self._stacks:
            await stack.settle()
        while not any(stack.retired for stack in self._stacks):
            self._runtime.outside_changed.clear()
            try:
                await self._try_range(or_fast=False)
            except OSError as error:  # another program has just taken a free port
                log.debug("the proxy could not try the range: %s", error)
            await self._until_due()

    async def _until_due(self) -> None:
        """Wait until the next test: after a change, or after RETRY_INTERVAL_S without a proof."""
        changed = self._runtime.outside_changed
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RETRY_INTERVAL_S):
                    await changed.wait()
                    await asyncio.sleep(LEAST_INTERVAL_S)
            former_addresses = self._addresses
            await self._look_at_host()
            if changed.is_set() or self._addresses != former_addresses or not self._is_proven:
                return

    @property
    def _is_proven(self) -> bool:
        """Whether the last test has proven that outside reaches the range, without a fault."""
        return not self.findings and self._result is not None and self._result.reached is True

    async def _look_at_host(self) -> None:
        """Resolve the advertised host, and report its faults."""
        host = self._runtime.settings.advertise_host
        if not host:  # rmw_zenoh alone advertises no host
            return
        self._addresses = await resolve(host)
        all_here = await self._all_here()
        self._note(HOST, advertised_host(host, self._addresses, all_here))

    async def _all_here(self) -> bool:
        """Whether the master and all peers are on this machine, without a LAN relay."""
        settings = self._runtime.settings
        outside = [[address] for address in await peer_addresses(settings)]
        if settings.for_ros1:
            master = parse_authority(settings.master_uri)
            host = settings.master_address or (master.host if master else "")
            outside.append([host, *await resolve(host)])
        return is_all_here(outside, settings.for_ros2 and settings.ros2_lan_relay is not None)

    async def _try_range(self, or_fast: bool) -> RangeProbe:
        """Test ports of the range, and report faults.

        ``or_fast``: see `Stack.probe`. Raises OSError if another program has just taken a port.
        """
        async with self._probing:
            probes = [await stack.probe(or_fast) for stack in self._stacks]
        probed = RangeProbe(tuple(probe for of_stack in probes for probe in of_stack))
        settings = self._runtime.settings
        ports = PortsStatus(str(settings.ports.listen), str(settings.ports.advertise))
        result = probe_result(probed)
        # If no port was free, the last result stays. If the advertised host is unresolvable,
        # `_look_at_host` has reported that fault.
        if self._addresses and result is not None:
            self._result = result
            self._tried_at = self._runtime.now()
            findings = list(published_range(probed, settings.advertise_host, ports))
            self._note(RANGE, findings)
            self._tell_ready(findings)
        return probed

    def _tell_ready(self, findings: Sequence[DoctorFinding]) -> None:
        """Log ``ready`` with the results, once, after the first test without a fault."""
        if not self._is_ready and not self.findings:
            self._is_ready = True
            log.info("ready: %s", "; ".join(finding.text for finding in findings))

    def _note(self, subject: str, findings: Iterable[DoctorFinding]) -> None:
        """Report the faults of a subject, once until the faults change."""
        wrong = [f for f in findings if f.severity >= Severity.WARNING]
        previous = self._findings.get(subject, [])
        self._findings[subject] = wrong
        self._runtime.metrics.setup_faults.set(len(self.findings))
        if wrong == previous:
            return
        self._runtime.problems.solved(subject)
        for finding in wrong:
            text = f"{finding.text}. {finding.fix}"
            self._runtime.problems.add(subject, text, holds=True)
            level = logging.ERROR if finding.severity is Severity.ERROR else logging.WARNING
            log.log(level, "%s: %s", subject, text)
        if previous and not wrong:
            log.info("%s: the fault is over", subject)
