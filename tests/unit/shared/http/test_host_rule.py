"""By which names the admin endpoint answers."""

import pytest

from rosproxy.shared.http.host_rule import is_own_host

OWN = frozenset({"robot.lab.example"})


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1:11312",
        "[::1]:11312",
        "[fe80::1]",
        "10.244.1.7:11312",
        "192.168.1.4",
        "localhost:8080",
        "robot:11312",
        "rosproxy-robot-1f3a9c:11312",
        "robot.local:11312",
        "rosproxy.robots.svc:11312",
        "rosproxy.robots.svc.cluster.local:11312",
        "host.docker.internal:11312",
        "robot.lab.example",
        "ROBOT.lab.example.:11312",
        "",
    ],
)
def test_the_names_of_legitimate_clients(host: str) -> None:
    assert is_own_host(host, OWN)


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:11312",
        "evil.example",
        "evil.example.",
        "127.0.0.1.evil.example",
        "localhost.evil.example:80",
        "lab.example",
        "x.robot.lab.example",
        "evil.example:0",
        "evil.example:port",
        "rosproxy.dev:11312",
    ],
)
def test_names_that_strangers_may_have(host: str) -> None:
    assert not is_own_host(host, OWN)
