"""The layer abuse: a real proxy with bad neighbours, of whom nobody else may notice anything.

How it works. Each test gets `abused`, a `rosproxy run` as a process of its own in a cgroup of
256 MB, so that a test which makes it take more kills it. Its master and its nodes are the fakes of
examples/demo, in the test's own process and outside of the cgroup, on addresses of 127.0.0.0/8 as
in tests/integration, whose helpers are used: the neighbour's calls and raw connections come from
`tests.integration.net`. What a test does happens within ``with abused.watched():``, which holds for
all of them what nobody may lose:

  - /healthz answers within a second throughout, asked by another process;
  - memory stays below what it was before and 100 MB;
  - the log grows by 64 KiB at most, and has no traceback; /status has 1 MiB at most.

Tests say themselves that a good neighbour is served meanwhile. It needs root, for the cgroup and to
go before whatever else this machine does, which is no neighbour of the proxy's; it needs no other
program. Tests of one subject are in one file.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.request import urlopen

import pytest

from examples.demo.fake_http import Where
from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from tests.abuse.cgroup import MemoryGroup
from tests.abuse.health import Health
from tests.integration.conftest import (  # noqa: F401 - fixtures
    _ports_of_this_worker,
    make_node,
    master,
    node,
)
from tests.integration.net import HOST, until
from tests.integration.process import Process

MEBIBYTE = 1024 * 1024
MEMORY = 256 * MEBIBYTE
GROWTH = 100 * 1000 * 1000
PATIENT = {"probe_interval": 5, "probe_timeout": 20, "cleanup_after": 0, "linger": 600}
"""The fakes answer late: they live in the process that makes the neighbours' huge documents."""
LOG, STATUS = 64 * 1024, MEBIBYTE
PRIORITY = -15
"""Of the test, and of all that it starts, among the processes of this machine (nice)."""


@pytest.fixture(autouse=True, scope="session")
def _first_in_line() -> Iterator[None]:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    yield
    os.setpriority(os.PRIO_PROCESS, 0, before)


class Abused(Process):
    """A proxy under attack."""

    @property
    def admin(self) -> Where:
        """Its admin endpoint."""
        host, port = self.options["admin_bind"].split(":")
        return host, int(port)

    def get(self, path: str) -> str:
        """A page of the admin endpoint."""
        host, port = self.admin
        with urlopen(f"http://{host}:{port}{path}", timeout=30) as reply:
            return str(reply.read().decode())

    def status(self) -> dict[str, Any]:
        """What it tells of itself."""
        found: dict[str, Any] = json.loads(self.get("/status"))
        return found

    def refused(self) -> set[str]:
        """The reasons for which it has refused something."""
        lines = self.get("/metrics").splitlines()
        return {line.split('"')[1] for line in lines if line.startswith("rosproxy_refused_total{")}

    def lease(self, of: FakeNode) -> Where:
        """Where outside reaches a node."""
        found = next(held for held in self.status()["nodes"] if of.name in held["nodes"])
        return HOST, found["port"]

    async def publish(self, of: FakeNode) -> Where:
        """Have a node register, and find out where outside reaches it."""
        await until(lambda: self.status()["master"]["up"], "the master is found")
        await of.publish(self.master)
        return self.lease(of)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Hold what nobody may lose."""
        before, written = self.most_memory(), len("".join(self.log))
        with Health(self.admin[1]) as health:
            yield
        assert health.longest < 1
        assert self.most_memory() - before < GROWTH
        assert len("".join(self.log)) - written < LOG
        assert len(self.get("/status")) < STATUS


@pytest.fixture
def abused(master: FakeMaster, tmp_path: Any) -> Iterator[Abused]:  # noqa: F811 - the fixture
    """A proxy in a cgroup of 256 MB."""
    group = MemoryGroup(f"rosproxy-abuse-{os.getpid()}", MEMORY)
    made: list[Abused] = []
    try:
        made.append(Abused({"master_uri": master.uri, "prefix": group.prefix, **PATIENT}))
        yield made[0]
    finally:
        for process in made:
            process.close()
        group.remove()
