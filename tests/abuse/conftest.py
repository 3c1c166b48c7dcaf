"""The layer abuse: a real proxy with hostile neighbours, which no other program may notice.

Each test gets `abused`, a separate process of `rosproxy run` in a cgroup of 256 MB. If the proxy
takes more memory, the kernel kills the proxy. The master and the nodes are the fakes of
examples/demo, in the process of the test and outside of the cgroup, on addresses of 127.0.0.0/8.
The neighbour's calls and raw connections come from `tests.integration.net`. If the addresses have
to belong to other machines, a test gets `apart`, the same in a network namespace
(:mod:`tests.abuse.apart`). The attack is in the body of ``with abused.watched():``, which checks:

  - /healthz answers within 0.3 s of a reference processor throughout, to another process. Time in
    which the two wait for a processor does not count (:mod:`tests.abuse.health`);
  - memory grows by 16 MiB at most, or by the bytes that a test gives with a reason;
  - the log grows by 64 KiB at most, and has no traceback; /status has 1 MiB at most.

Each test checks that the proxy serves a good neighbour meanwhile. The layer needs root for the
cgroup, for the namespace (`ip` of iproute2), and for a priority over all other programs of this
machine, which are no neighbours of the proxy.
"""

import json
import os
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from urllib.request import urlopen

import pytest

from examples.demo.fake_http import Address, free_ports
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from tests.abuse.apart import APART, APART_HOST, APART_MASTER, INSIDE, Apart
from tests.abuse.cgroup import Cgroup
from tests.abuse.health import Health
from tests.integration.conftest import (  # noqa: F401 - fixtures
    make_node,
    master,
    node,
)
from tests.integration.net import until
from tests.integration.process import Process

MEBIBYTE = 1024 * 1024
MEMORY = 256 * MEBIBYTE
GROWTH = 16 * MEBIBYTE
LONGEST_ANSWER = 0.3
"""Seconds of a reference processor that an answer of /healthz may take."""
PATIENT = {"probe_interval": 5, "probe_timeout": 20, "cleanup_after": 0, "linger": 600}
"""The fakes answer late, because the same process makes the neighbours' huge documents."""
LOG = 64 * 1024
STATUS = MEBIBYTE
PRIORITY = -15
"""The priority (nice) of the test and of all processes that the test starts."""


@pytest.fixture(autouse=True, scope="session")
def _first_in_line() -> Iterator[None]:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    yield
    os.setpriority(os.PRIO_PROCESS, 0, before)


class Abused(Process):
    """A proxy under attack, in ``group``."""

    def __init__(self, group: Cgroup, options: dict[str, Any]) -> None:
        self.group = group
        super().__init__(options | {"prefix": [*group.prefix, *options.get("prefix", [])]})

    @property
    def admin(self) -> Address:
        """The admin endpoint."""
        host, port = self.options["admin_bind"].split(":")
        return host, int(port)

    def get(self, path: str) -> str:
        """A page of the admin endpoint."""
        host, port = self.admin
        with urlopen(f"http://{host}:{port}{path}", timeout=30) as reply:
            return str(reply.read().decode())

    def status(self) -> dict[str, Any]:
        """The answer of /status."""
        document: dict[str, Any] = json.loads(self.get("/status"))
        return document

    def refused(self) -> set[str]:
        """The reasons of refusals so far."""
        lines = self.get("/metrics").splitlines()
        told = [line for line in lines if line.startswith("rosproxy_refused_total{")]
        return {line.split('"')[1] for line in told if float(line.split()[-1])}

    def metric(self, name: str) -> float:
        """The value of a metric, by name and labels."""
        (line,) = (line for line in self.get("/metrics").splitlines() if line.startswith(name))
        return float(line.split()[-1])

    def lease(self, of: FakeNode) -> Address:
        """The address at which outside reaches a node."""
        lease = next(lease for lease in self.status()["nodes"] if of.name in lease["nodes"])
        return self.options["advertise_host"], lease["port"]

    async def publish(self, of: FakeNode) -> Address:
        """Register a node. Return the address for outside."""
        await until(lambda: self.status()["master"]["up"], "the master is found")
        await of.publish(self.master)
        return self.lease(of)

    @contextmanager
    def watched(self, growth: int = GROWTH) -> Iterator[None]:
        """Check health, memory, log and status. Memory may grow by ``growth`` bytes."""
        before = self.most_memory()
        written = len("".join(self.log))
        with Health(*self.admin, self.pid) as health:
            yield
        assert health.longest < LONGEST_ANSWER
        assert self.most_memory() - before < growth
        assert len("".join(self.log)) - written < LOG
        assert len(self.get("/status")) < STATUS


StartAbused = Callable[..., Abused]


@pytest.fixture
def start_abused() -> Iterator[StartAbused]:
    """Starts proxies in a cgroup of 256 MB each, with these options."""
    with ExitStack() as stack:

        def start(**options: Any) -> Abused:
            group = Cgroup(f"rosproxy-abuse-{os.getpid()}", MEMORY)
            stack.callback(group.remove)
            made = Abused(group, {**PATIENT, **options})
            stack.callback(made.close)
            return made

        yield start


@pytest.fixture
def abused(start_abused: StartAbused, master: FakeMaster) -> Abused:  # noqa: F811 - the fixture
    """A proxy on loopback."""
    return start_abused(master_uri=master.uri)


@pytest.fixture(scope="session")
def _apart() -> Iterator[Apart]:
    made = Apart()
    yield made
    made.remove()


@pytest.fixture
async def apart_master(_apart: Apart) -> AsyncIterator[FakeMaster]:
    """A master on another machine than the proxy of `start_apart`."""
    made = FakeMaster(APART_MASTER)
    await made.start()
    yield made
    await made.stop()


@pytest.fixture
def start_apart(_apart: Apart, start_abused: StartAbused, apart_master: FakeMaster) -> StartAbused:
    """Starts proxies on a separate machine; see `tests.abuse.apart`."""

    def start(**options: Any) -> Abused:
        own = {
            "master_uri": apart_master.uri,
            "prefix": _apart.prefix,
            "advertise_host": APART_HOST,
            "inside_network": INSIDE,
            "admin_bind": f"{APART}:{free_ports(1)}",
        }
        made = start_abused(**{**own, **options})
        made.master = APART, made.master[1]
        return made

    return start


@pytest.fixture
def apart(start_apart: StartAbused) -> Abused:
    """A proxy on a separate machine."""
    return start_apart()
