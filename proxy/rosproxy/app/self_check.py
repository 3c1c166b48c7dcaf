"""What a proxy finds out about itself: whether outside can reach it as it is told to.

At its start the advertised host is looked up first. Then, once the rush of a start is over and the
master answers, the range is tried from outside (`rosproxy.ros1.range_probe`; of ROS 2 by UDP, which
can prove that all is well, and not that it is not). Only after that the log says ``ready``. What is
wrong is told in the log and in ``rosproxy status``, in the doctor's words, and tried again at times
until it is mended. What was proven is tried again when it may have changed: the master was away or
is elsewhere now, or the advertised host's name leads to other addresses. None of this keeps
anything from working: who can reach the proxy does. How the last try ended is a field of the status
of its own (``range_probe``).
"""

import asyncio
import contextlib
import logging
from collections.abc import Iterable, Sequence
from typing import Any

from msgspec.structs import replace

from rosproxy.admin.doctor_finding import DoctorFinding, Severity
from rosproxy.admin.requests import RangeProbe
from rosproxy.admin.setup_rules import (
    HOST,
    RANGE,
    advertised_host,
    probe_result,
    published_range,
)
from rosproxy.admin.status_document import PortsStatus, RangeProbeStatus, to_json
from rosproxy.app.stacks import Stack
from rosproxy.net.addresses import is_loopback, parse_authority
from rosproxy.net.resolver import resolve
from rosproxy.runtime import Runtime

log = logging.getLogger(__name__)

SETTLE_TIME = 3.0
"""Seconds after which the range is tried at the earliest: nodes that come back go first."""
RETRY_INTERVAL = 300.0
"""Seconds between tries while something is wrong. A master that does not get through holds one of
its three threads for two minutes."""
LEAST_INTERVAL = 30.0
"""Seconds between tries however often something changes."""


class SelfCheck:
    """Looks into the setting-up of a running proxy and notes what is wrong."""

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
        """What is wrong, as far as is known."""
        return [finding for findings in self._findings.values() for finding in findings]

    @property
    def result(self) -> RangeProbeStatus | None:
        """How the last try at the range ended; None if there was none."""
        if self._result is None:
            return None
        return replace(self._result, age=round(self._runtime.now() - self._tried_at, 1))

    async def start(self) -> None:
        """Look at the advertised host, and try the range in a moment."""
        await self._look_at_host()
        self._runtime.tasks.spawn(self._keep_trying(), "trying the range from outside")

    async def probe(self, body: Any) -> dict[str, Any]:
        """``POST /probe``: how some ports of the range were reached."""
        return to_json(await self._try_range(or_fast=True))

    async def _keep_trying(self) -> None:
        await asyncio.sleep(SETTLE_TIME)
        for stack in self._stacks:
            await stack.settle()
        while not any(stack.retired for stack in self._stacks):
            self._runtime.outside_changed.clear()
            try:
                await self._try_range(or_fast=False)
            except OSError as error:  # a port that was free a moment ago
                log.debug("the proxy could not try the range: %s", error)
            await self._until_due()

    async def _until_due(self) -> None:
        """Wait until it is time for another try."""
        changed = self._runtime.outside_changed
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RETRY_INTERVAL):
                    await changed.wait()
                    await asyncio.sleep(LEAST_INTERVAL)
            former_addresses = self._addresses
            await self._look_at_host()
            if changed.is_set() or self._addresses != former_addresses or not self._is_proven:
                return

    @property
    def _is_proven(self) -> bool:
        """Whether outside was seen to get in, and nothing is wrong."""
        return not self.findings and self._result is not None and self._result.reached is True

    async def _look_at_host(self) -> None:
        host = self._runtime.settings.advertise_host
        if not host:  # rmw_zenoh alone advertises no host
            return
        self._addresses = await resolve(host)
        all_here = await self._all_here()
        self._note(HOST, advertised_host(host, self._addresses, all_here))

    async def _all_here(self) -> bool:
        """Whether the proxy knows of nobody outside but on loopback: a trial on one machine."""
        settings = self._runtime.settings
        hosts = [peer.host for peer in settings.ros2_peer] if settings.for_ros2 else []
        if settings.for_ros1:
            master = parse_authority(settings.master_uri)
            hosts += [settings.master_address or (master.host if master else "")]
        # A host name that can't be resolved counts as one of another machine.
        resolved = [await resolve(host) or [host] for host in hosts]
        return bool(resolved) and all(any(map(is_loopback, addresses)) for addresses in resolved)

    async def _try_range(self, or_fast: bool) -> RangeProbe:
        """Try ports of the range, and note what is wrong. Raises OSError if one was just taken."""
        async with self._probing:
            probes = [await stack.probe(or_fast) for stack in self._stacks]
        probed = RangeProbe(tuple(probe for of_stack in probes for probe in of_stack))
        settings = self._runtime.settings
        ports = PortsStatus(str(settings.ports.listen), str(settings.ports.advertise))
        result = probe_result(probed)
        # Where no port was free, what was found before holds. Where the host's name leads nowhere,
        # that is reported.
        if self._addresses and result is not None:
            self._result = result
            self._tried_at = self._runtime.now()
            findings = list(published_range(probed, settings.advertise_host, ports))
            self._note(RANGE, findings)
            self._tell_ready(findings)
        return probed

    def _tell_ready(self, findings: Sequence[DoctorFinding]) -> None:
        """Log once, when nothing is wrong for the first time, how far outside was seen to get."""
        if not self._is_ready and not self.findings:
            self._is_ready = True
            log.info("ready: %s", "; ".join(finding.text for finding in findings))

    def _note(self, subject: str, findings: Iterable[DoctorFinding]) -> None:
        """Report what is wrong, once for as long as it is."""
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
            log.info("%s: nothing is wrong any more", subject)
