"""Shared by all layers: ports that no other worker draws."""

import os

import pytest

from examples.demo.fake_http import PORTS


@pytest.fixture(autouse=True, scope="session")
def _ports_of_this_worker() -> None:
    """Tests that run side by side draw ports from separate ranges."""
    number = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    count = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    size = len(PORTS.ports) // count
    PORTS.keep_to(PORTS.ports[number * size : (number + 1) * size])
