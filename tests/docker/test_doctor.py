"""Faults on a host in the doctor's report: the first cause, and the fix."""

import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.docker.controller import OPTIONS, Process, proxies, remove_proxies, the_proxy
from tests.docker.engine import docker, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.robot import Robot, named_robot

SCOUT = 94


@pytest.fixture
def process(tmp_path: Path, proxy_image: str, named: Robot, _no_other_controller: None) -> Process:
    options = ("--proxy-image", proxy_image)
    return Process(tmp_path, *options, names={named.name: named.address})


def asked(process: Process, *words: str) -> tuple[int, dict[str, Any]]:
    """The exit code and the JSON output of a command."""
    text = process.once(*words, "--json", check=False)
    assert process.process is not None
    document: dict[str, Any] = json.loads(text[text.index("{") :])
    return process.process.returncode, document


def wrong(process: Process) -> tuple[int, list[dict[str, Any]]]:
    """The exit code of ``doctor``, and all errors and warnings."""
    code, report = asked(process, "doctor")
    severe = [
        finding for finding in report["findings"] if finding["severity"] in ("error", "warning")
    ]
    return code, severe


def page() -> dict[str, Any]:
    """The document of the operator's live page."""
    with urllib.request.urlopen(f"http://{OPTIONS[-1]}/graph", timeout=30) as reply:
        graph: dict[str, Any] = json.loads(reply.read())
    return graph


def warnings_on_page(container: str) -> list[str]:
    """The texts of the warnings about a container on the live page; none without a page yet."""
    wanted = ("warning", f"container {container}")
    try:
        findings = page()["findings"]
    except urllib.error.URLError:
        return []
    return [f["text"] for f in findings if (f["severity"], f["subject"]) == wanted]


@pytest.fixture(scope="module")
def named(ros_image: str) -> Iterator[Robot]:
    """A robot with a new master, without nodes of other tests."""
    with named_robot(ros_image, "scout", SCOUT) as robot:
        robot.start_master()
        yield robot


def test_from_a_plan_to_a_host_that_is_well(process: Process, net: Inside, named: Robot) -> None:
    network = net.network()
    try:
        code, planned = asked(process, "plan")
        assert (code, planned) == (0, {"actions": [], "problems": []})
        node = net.node(network, "rospy", "pub", "--topic", "/out")
        code, planned = asked(process, "plan")
        assert code == 3
        assert any("create" in action for action in planned["actions"])
        assert wrong(process)[1][0]["fix"].startswith("start the operator")
        process.once("status", "--wait", "1", check=False)
        assert process.process is not None
        assert process.process.returncode == 1

        process.start()
        waiting = Process(process._directory, names={named.name: named.address})
        waiting.options = process.options
        status = json.loads(waiting.once("status", "--wait", "90", "--json"))
        assert status["proxies"][0]["reachable"]
        assert waiting.once("plan", "--wait", "60") == "Nothing to do."
        wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)
        wait_until(lambda: wrong(waiting) == (0, []), 60, lambda: str(wrong(waiting)))
        text = " ".join(waiting.once("doctor", "/out", check=False).split())
        assert f"proxy {the_proxy().name}: /out: published by /{node.node}" in text
        shown = page()["nodes"]
        assert shown[f"{the_proxy().name} /{node.node}"]["lane"] == "container"
        assert shown[f"{named.master_uri} master"]["lane"] == "robot"
        assert "no node subscribes to /out" in text

        url = "http://127.0.0.1:11312/policy"
        body = '{"layers": [{"name": "a", "mode": "enforce", "rules": "deny everything"}]}'
        code_here = (
            "import sys, urllib.request as u; r = u.Request(sys.argv[1], sys.argv[2].encode(), "
            "method='POST')\ntry: u.urlopen(r)\nexcept u.HTTPError as e: print(e.code)"
        )
        assert docker("exec", the_proxy().name, "python3", "-c", code_here, url, body) == "400"
        assert "the operator's policy: refused" in waiting.once("status", check=False)
        # The master stays for the next test: a node that is still registered is a finding there.
        node.remove()
        wait_until(lambda: not named.uri(node.node), 60, process.logs)
    finally:
        process.stop()
        remove_proxies()


def test_ended_nodes_are_no_fault(process: Process, net: Inside, named: Robot) -> None:
    """Each restart of a container leaves a held port, but the same node."""
    process.start()
    try:
        node = net.node(net.network(), "roscpp", "pub", "--topic", "/out")
        uris: set[str | None] = set()
        for _ in range(3):
            wait_until(
                lambda: named.knows_proxied(node.node) and named.uri(node.node) not in uris, 60,
                node.log.read,
            )  # fmt: skip
            uris.add(named.uri(node.node))
            docker("restart", "--time", "1", node.name)
        asking = Process(process._directory, names={named.name: named.address})
        asking.options = process.options
        wait_until(lambda: wrong(asking) == (0, []), 60, lambda: str(wrong(asking)))
        said = docker("exec", the_proxy().name, "rosproxy", "doctor")
        assert "1 of 1 answer; ended nodes still hold" in said
    finally:
        process.stop()
        remove_proxies()


def test_a_removed_container_is_no_fault(process: Process, net: Inside, named: Robot) -> None:
    """While the proxy still holds the port."""
    process.start()
    try:
        network = net.network()
        stays = net.node(network, "roscpp", "sub", "--topic", "/out")
        node = net.node(network, "rospy", "pub", "--topic", "/out")
        for made in (stays, node):
            wait_until(partial(named.knows_proxied, made.node), 60, made.log.read)
        stays.log.wait_for("")
        asking = Process(process._directory, names={named.name: named.address})
        asking.options = process.options

        docker("rm", "--force", node.name)

        held = "1 of 1 answer; ended nodes still hold 1 port"
        doctor = ("exec", the_proxy().name, "rosproxy", "doctor")
        wait_until(lambda: held in docker(*doctor, check=False), 25, asking.logs)
        assert not [f for f in wrong(asking)[1] if node.node in str(f)]
        wait_until(lambda: node.node not in json.dumps(page()), 20, lambda: json.dumps(page()))
        assert held in docker(*doctor, check=False)
    finally:
        process.stop()
        remove_proxies()


def test_a_misspelt_label(process: Process, net: Inside) -> None:
    node = net.idle(net.network(), labels=("ros-proxy.enable=true",))
    _, findings = wrong(process)
    (told,) = [finding for finding in findings if finding["subject"] == f"container {node.name}"]
    assert "label ros-proxy.enable is unknown and ignored" in told["text"]
    assert "Did you mean rosproxy.enable?" in told["text"]
    assert "Did you mean rosproxy.enable?" in process.once("status", check=False)
    process.start()
    try:
        wait_until(lambda: told["text"] in warnings_on_page(node.name), 30, process.logs)
    finally:
        process.stop()


def test_a_masters_name_that_leads_nowhere_and_its_fix(
    tmp_path: Path, process: Process, net: Inside, named: Robot
) -> None:
    """The fix is about the host name, not about a label. After the fix all is well."""
    blind = Process(tmp_path, "--proxy-image", process.options[-1])
    blind._names.clear()
    blind._hosts.write_text("")
    node = net.node(net.network(), "rospy", "pub", "--topic", "/out")
    code, findings = wrong(blind)
    assert code == 1
    assert findings[0]["subject"] == f"master {named.name}"
    (told,) = [finding for finding in findings if finding["subject"] == f"container {node.name}"]
    for finding in (findings[0], told):
        assert f"the operator can't resolve the host name {named.name}" in finding["text"]
        assert f"--add-host {named.name}:ADDRESS" in finding["fix"]
        assert "rosproxy.advertise-host" not in finding["fix"]
    try:
        blind.name(named.name, named.address)
        blind.once("--once")
        assert [proxy.running for proxy in proxies()] == [True]
        assert not [finding for finding in wrong(blind)[1] if "container" in finding["subject"]]
        assert not [finding for finding in wrong(blind)[1] if "master" in finding["check"]]
        wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)
        assert named.run("rostopic", "echo", "-n", "1", "/out")
    finally:
        remove_proxies()


def test_a_proxy_that_outside_does_not_reach(process: Process, net: Inside) -> None:
    """Nothing answers at 192.0.2.1. The fix names the operator's label."""
    net.idle(net.network(), labels=(ENABLE, "rosproxy.advertise-host=192.0.2.1"))
    try:
        process.once("--once")
        code, findings = wrong(process)
        (told,) = [finding for finding in findings if finding["check"] == "published range"]
        assert code == 1
        assert "192.0.2.1" in told["text"]
        assert "label rosproxy.advertise-host=ADDRESS" in told["fix"]
        wait_until(
            lambda: "published range: 192.0.2.1" in process.once("status", check=False), 60,
            lambda: process.once("status", check=False),
        )  # fmt: skip
        assert process.process is not None
        assert process.process.returncode == 1, "a script is told as well"
    finally:
        remove_proxies()
