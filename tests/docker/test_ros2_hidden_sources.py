"""An engine that forwards outside datagrams with the gateway's address, like rootless engines."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from tests.docker.controller import Controller, Proxy, the_proxy
from tests.docker.engine import docker, inspect, run, wait_until
from tests.docker.inside import ENABLE
from tests.docker.ros2 import HERE, THERE, Inside2, Outside, wait_for_line


@pytest.fixture(autouse=True)
def _nodes_end(lan: Outside) -> Iterator[None]:
    yield
    lan.end()


@contextmanager
def hidden_sources(proxy: Proxy) -> Iterator[None]:
    """The host replaces the source of all that comes to the proxy's published ports."""
    uplink = inspect(proxy.sandbox)["NetworkSettings"]["Networks"]["0-rosproxy"]
    rule = ("-d", uplink["IPAddress"], "-p", "udp", "-j", "MASQUERADE")
    run("iptables", "-t", "nat", "-I", "POSTROUTING", *rule)
    run("conntrack", "-D", "-p", "udp", check=False)
    try:
        yield
    finally:
        run("iptables", "-t", "nat", "-D", "POSTROUTING", *rule)
        run("conntrack", "-D", "-p", "udp", check=False)


def first_error(controller: Controller) -> dict[str, str]:
    """The first error that the operator's doctor reports."""
    text = controller.command("doctor", "--json", check=False)
    findings: list[dict[str, str]] = json.loads(text[text.index("{") :])["findings"]
    return next((finding for finding in findings if finding["severity"] == "error"), {})


def test_the_cause_is_named_and_its_fix_works(
    start_controller: Callable[..., Controller], lan: Outside, inside2: Inside2
) -> None:
    """Without a LAN relay: that of a rootless engine hears no LAN."""
    controller = start_controller("--ports", "32", "--advertise-host", HERE, "--ros2-lan", "none")
    labels = (ENABLE, f"rosproxy.peers={THERE}")
    inside2.node(inside2.made.network(), "jazzy", "pub", "/out", labels=labels)
    proxy = the_proxy(60)
    with hidden_sources(proxy):
        reader = lan.node("jazzy", "sub", "/out")
        wait_until(
            lambda: first_error(controller).get("subject", "").endswith("hidden source"), 60,
            lambda: docker("logs", proxy.name),
        )  # fmt: skip
        fix = first_error(controller)["fix"]
        assert "DOCKERD_ROOTLESS_ROOTLESSKIT_PORT_DRIVER=slirp4netns" in fix
        assert "got hello" not in reader.log.read()

    wait_for_line(reader.log, "^got hello ")
