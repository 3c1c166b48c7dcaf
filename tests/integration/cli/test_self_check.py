"""Self-checks of ``rosproxy run`` at its start, and of ``--check --deep``."""

import asyncio
import json
import subprocess
from typing import Any

import pytest

from examples.demo.fake_http import FakeHttpServer, FakeRequest, free_ports, value
from examples.demo.fake_master import FakeMaster
from examples.demo.proxy_process import clean_environment
from rosproxy.ros1.range_probe import probe_range
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.requests import PortProbe
from tests.clock import pass_time
from tests.integration.admin_calls import tell
from tests.integration.commands import run
from tests.integration.conftest import MakeNode, MakeProxy
from tests.integration.doctor.test_doctor import examine
from tests.integration.net import MASTER, rpc, until
from tests.integration.own_domain import own_domain
from tests.integration.process import Process, command_line
from tests.integration.proxy import Proxy, options_for

DOMAIN = own_domain()
OTHER_DOMAIN = own_domain()
NOT_FOUND = b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"


def started(options: dict[str, Any]) -> "subprocess.CompletedProcess[str]":
    """``rosproxy run``, which is expected to end by itself."""
    command = command_line(options)
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env=clean_environment()
    )


def admin_of(process: Process) -> str:
    return f"http://{process.options['admin_bind']}"


async def status(process: Process) -> dict[str, Any]:
    ended = await run("status", "--json", "--admin", admin_of(process))
    document: dict[str, Any] = json.loads(ended.out)
    return document


async def problems(process: Process) -> list[str]:
    return [
        f"{problem['subject']}: {problem['text']}"
        for problem in (await status(process))["problems"]
    ]


async def test_a_second_proxy_on_the_range_of_the_first_ends_and_names_it(start_process, node):
    """If both ran, nodes would get ports of either proxy."""
    first: Process = start_process()
    assert (await node.publish(first.master))[0] == 1
    second = options_for(master_uri=first.options["master_uri"])
    second["port_range"] = first.options["port_range"]
    ended = await asyncio.to_thread(started, second)
    assert ended.returncode == 2
    (line,) = [line for line in ended.stderr.splitlines() if line.startswith("rosproxy: ")]
    assert line.startswith("rosproxy: --port-range: no port of ")
    assert f"held by another rosproxy, with --port-range {first.options['port_range']}" in line
    assert f"rosproxy status --admin {admin_of(first)}" in line
    await node.publish(first.master)
    assert (await status(first))["ports"]["blocked"] == 0


@pytest.mark.parametrize("ros", [{}, {"ros": "2", "ros2_domain": DOMAIN, "ros2_peer": "127.0.0.1"}])
async def test_a_proxy_that_is_started_twice_names_itself(start_process, ros):
    """Even with the same admin endpoint."""
    first: Process = start_process(**ros)
    ended = await asyncio.to_thread(started, first.options)
    assert ended.returncode == 2
    assert f"another rosproxy, with --port-range {first.options['port_range']}" in ended.stderr
    assert f"rosproxy status --admin {admin_of(first)}" in ended.stderr


async def test_a_second_proxy_on_a_part_of_the_range_names_the_first(start_process):
    low = free_ports(7)
    port = low + 3
    first: Process = start_process(port_range=f"{port}-{low + 6}")
    second: Process = start_process(port_range=f"{low}-{port}")
    told = "\n".join(await problems(second))
    assert f"held by other programs: [{port}]" in told
    assert f"held by another rosproxy, with --port-range {first.options['port_range']}" in told
    assert admin_of(first) in told
    text = (await run("doctor", "--admin", admin_of(second))).out
    assert "set another --port-range" in text
    first.kill()
    first.start()
    assert (await status(first))["ports"]["blocked"] == 0, "the same ports again"


@pytest.mark.parametrize("domain", [DOMAIN, OTHER_DOMAIN], ids=["same", "other"])
async def test_a_second_proxy_of_ros2_on_the_range_names_the_first(start_process, domain):
    """A machine can have only one proxy for a domain anyway."""
    first: Process = start_process(ros="2", ros2_domain=DOMAIN, ros2_peer="127.0.0.1")
    options = options_for(ros="2", ros2_domain=domain, ros2_peer="127.0.0.1")
    options["port_range"] = first.options["port_range"]
    ended = await asyncio.to_thread(started, options)
    assert ended.returncode == 2
    assert f"another rosproxy, with --port-range {first.options['port_range']}" in ended.stderr


async def test_doctor_takes_no_living_node_of_another_proxy_for_dead(
    make_proxy: MakeProxy, proxy: Proxy, node, master
) -> None:
    """Both proxies have the same advertised host and range. A clean-up would be the wrong fix."""
    await node.publish(proxy.master)
    port = proxy.settings.ports.listen.last
    uri = f"http://{proxy.settings.advertise_host}:{port}/{node.address}:{node.slave.address[1]}/"
    await rpc(master.uri, "registerPublisher", "/others", "/t", "a/B", uri)
    await rpc(master.uri, "registerPublisher", "/ghost", "/t", "a/B", uri.replace(str(port), "9"))
    errors = [finding for finding in await examine(proxy) if finding.severity is Severity.ERROR]
    assert (errors[0].check, errors[0].subject) == ("two proxies", "/others")
    assert "another rosproxy advertises the same host and ports" in errors[0].text
    assert "ROSPROXY_PORT_RANGE" in errors[0].fix
    assert all("rosnode cleanup (answer y)" not in finding.fix for finding in errors)


@pytest.mark.parametrize(
    ("host", "text", "fix"),
    [
        ("nowhere.invalid", "the host name nowhere.invalid can't be resolved here", "ADDRESS"),
        ("127.0.0.1", "127.0.0.1 is a loopback address", "the address of this host"),
        ("localhost", "localhost is a loopback address", "the address of this host"),
    ],
)
async def test_an_advertised_host_that_leads_nowhere_is_told_and_ready_is_not(
    start_process, host, text, fix
):
    process: Process = start_process(advertise_host=host, master_uri="http://192.0.2.7:11311")
    log = process.text
    assert log.index(text) < log.index("listening: ")
    assert "ERROR" in log[: log.index("listening: ")]
    assert "ready: " not in log
    (told,) = [
        problem for problem in await problems(process) if problem.startswith("advertised host: ")
    ]
    assert text in told
    assert fix in told
    assert told.removeprefix("advertised host: ")[:40] in (
        await run("status", "--admin", admin_of(process))
    ).out.replace("\n    ", " ")


async def test_loopback_is_fine_where_all_is_on_one_machine(start_process):
    process: Process = start_process(advertise_host="127.0.0.1")
    assert not await problems(process)


RELAY = {"ros2_lan_relay": "127.0.0.1:7500", "ros2_lan_relay_secret": "0123456789abcdef"}


@pytest.mark.parametrize(
    ("given", "is_fault"),
    [
        ({"ros2_peer": "localhost"}, False),
        ({"ros2_peer": "localhost", **RELAY}, True),
        (RELAY, True),
        ({}, True),
    ],
)
async def test_all_checks_agree_whether_outside_is_on_this_machine(start_process, given, is_fault):
    options = options_for(ros="2", ros2_domain=DOMAIN, advertise_host="127.0.0.1", **given)
    deep = await asyncio.to_thread(started, {**options, "check": True, "deep": True})
    process: Process = start_process(**options)
    doctor = await run("doctor", "--admin", admin_of(process))
    texts = {"deep": deep.stdout, "doctor": doctor.out, "self": "\n".join(await problems(process))}
    told = {name: "127.0.0.1 is a loopback address" in text for name, text in texts.items()}
    assert told == dict.fromkeys(texts, is_fault), texts


async def test_a_range_that_outside_does_not_reach_is_told_once_it_was_tried(start_process):
    """Neither the proxy nor the master reaches 192.0.2.1."""
    process: Process = start_process(advertise_host="192.0.2.1")
    await until(lambda: "published range: " in process.text, "the range was tried", 60)
    (told,) = [
        problem for problem in await problems(process) if problem.startswith("published range: ")
    ]
    assert ". publish the range: docker run -p" in told
    assert told in process.text
    document = await status(process)
    assert document["range_probe"]["reached"] is False
    assert [p["holds"] for p in document["problems"] if p["subject"] == "published range"] == [True]
    assert process.text.count("published range: ") == 1
    assert "ready: " not in process.text


async def test_ready_is_said_once_outside_was_seen_to_get_in(start_process):
    process: Process = start_process()
    await until(lambda: "ready: " in process.text, "the range was tried", 60)
    (line,) = [line for line in process.text.splitlines() if "ready: " in line]
    assert f"ready: the master reaches {process.options['advertise_host']}, port " in line


async def test_the_range_is_tried_until_outside_gets_in(
    make_proxy: MakeProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A try that no port was free for says nothing: what was found before holds."""
    dead = PortProbe(1, "h:1", "refused", "missed")
    sound = PortProbe(1, "h:1", "ok", "ok")
    scripted = iter([(dead,), (), (sound,), (dead,)])
    tries: list[tuple[PortProbe, ...]] = []

    async def probe(*_: Any) -> tuple[PortProbe, ...]:
        tries.append(next(scripted))
        return tries[-1]

    monkeypatch.setattr("rosproxy.ros1.stack.probe_range", probe)
    monkeypatch.setattr("rosproxy.app.self_check.RETRY_INTERVAL_S", 3.0)
    proxy = await make_proxy()
    assert proxy.app.state().range_probe is None
    for count, reached in ((1, False), (2, False), (3, True)):
        await pass_time(3.1)
        state = proxy.app.state()
        assert (len(tries), state.range_probe and state.range_probe.reached) == (count, reached)
        assert ["published range"] * (not reached) == [p.subject for p in state.problems]
    await pass_time(9)
    assert len(tries) == 3, "outside gets in: nothing is tried any more"


@pytest.mark.parametrize("change", ["the master was away", "its address", "the host's name"])
async def test_a_proven_range_is_tried_again_after_changes(
    change: str, make_proxy: MakeProxy, master: FakeMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Outside got in, and then does not any more."""
    dead = PortProbe(1, "h:1", "refused", "missed")
    sound = PortProbe(1, "h:1", "ok", "ok")
    outcome = [sound]
    tries = [0]
    addresses = ["127.0.0.1"]

    async def probe(*_: Any) -> tuple[PortProbe, ...]:
        tries[0] += 1
        return tuple(outcome)

    async def resolve(host: str) -> list[str]:
        return list(addresses)

    monkeypatch.setattr("rosproxy.ros1.stack.probe_range", probe)
    monkeypatch.setattr("rosproxy.app.self_check.resolve", resolve)
    monkeypatch.setattr("rosproxy.app.self_check.RETRY_INTERVAL_S", 12.0)
    monkeypatch.setattr("rosproxy.app.self_check.LEAST_INTERVAL_S", 3.0)
    proxy = await make_proxy()
    await pass_time(3.1)
    await pass_time(30)
    assert (tries, proxy.app.state().problems) == ([1], ())

    outcome[0] = dead
    if change == "the master was away":
        await master.stop()
        await pass_time(5)
        assert tries == [1], "no try while the master is away"
        await master.start()
    elif change == "its address":
        await tell(proxy, "/master-address", address="127.0.0.2")
        await tell(proxy, "/master-address", address="127.0.0.1")
    else:
        addresses[0] = "127.0.0.3"
    await pass_time(14)
    assert tries[0] > 1
    assert "published range" in {p.subject for p in proxy.app.state().problems}


def findings(text: str) -> list[DoctorFinding]:
    rows = json.loads(text)["findings"]
    return [DoctorFinding(**{**row, "severity": Severity[row["severity"].upper()]}) for row in rows]


async def deep(options: dict[str, Any]) -> tuple[int, str]:
    """The exit code and the output of ``run --check --deep``."""
    ended = await asyncio.to_thread(started, {**options, "check": True, "deep": True})
    assert "Traceback" not in ended.stderr
    return ended.returncode, ended.stdout + ended.stderr


async def test_the_deep_check_of_a_sound_proxy_ends_with_0_and_leaves_nothing(master):
    code, text = await deep(options_for(master_uri=master.uri))
    assert (code, "Nothing wrong was found." in text) == (0, True), text
    assert "the master reaches" in text
    assert not master.holds("publishers", "/chatter")
    assert not [name for name in master.nodes if "probe" in name]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"master_uri": "http://127.0.0.1:1"}, "refuses connections"),
        ({"advertise_host": "nowhere.invalid"}, "can't be resolved here"),
        (
            {"admin_bind": "nowhere.invalid:11312"},
            "--admin-bind: the host name nowhere.invalid can't be resolved here",
        ),
        ({"advertise_host": "192.0.2.1"}, "A call from the master does not arrive either"),
        ({"policy_file": "/nowhere/policy"}, "--policy-file: /nowhere/policy can't be read"),
    ],
)
async def test_the_deep_check_finds(master, options, text):
    code, told = await deep(options_for(**{"master_uri": master.uri, **options}))
    assert code == (2 if "policy_file" in options else 1), told
    assert text in " ".join(told.split())


async def test_the_deep_check_finds_a_master_at_another_path():
    async def respond(request: FakeRequest) -> bytes:
        return value([1, "", 7]) if request.path == "/" else NOT_FOUND

    fake = FakeHttpServer(respond)
    await fake.start(MASTER)
    at = f"{MASTER}:{fake.address[1]}"
    code, told = await deep(options_for(master_uri=f"http://{at}/ros"))
    await fake.stop()
    assert code == 1
    assert "not at the path /ros" in " ".join(told.split())
    assert f"--master-uri http://{at}/" in told


async def test_the_deep_check_names_another_proxy(start_process):
    first: Process = start_process()
    code, told = await deep({**first.options, "admin_bind": "127.0.0.1:11313"})
    assert code == 1
    assert "held by another rosproxy" in " ".join(told.split())


@pytest.mark.parametrize(("port", "code"), [(0, 0), (1, 1)])
async def test_the_deep_check_for_ros2(port, code):
    options = options_for(ros="2", ros2_domain=DOMAIN, ros2_peer="127.0.0.1")
    if port:
        options["advertise_host"] = "nowhere.invalid"
    ended, told = await deep(options)
    assert ended == code, told
    assert ("by UDP" if not code else "can't be resolved") in told


async def test_check_reads_the_policys_file(tmp_path):
    file = tmp_path / "policy"
    file.write_text("deny publish camera\n")
    ended = await asyncio.to_thread(
        started,
        {
            **options_for(master_uri="http://robot:11311"),
            "policy_file": str(file),
            "check": True,
        },
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith("rosproxy: --policy-file: ")


async def test_a_node_gets_a_port_during_its_trial(
    make_proxy: MakeProxy,
    make_node: MakeNode,
    master: FakeMaster,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The proxy tries its range just when nodes start, and roscpp never registers again."""
    monkeypatch.setattr(master, "_notify", lambda *_: None)  # its call does not arrive
    monkeypatch.setattr("rosproxy.ros1.range_probe.MASTER_TIMEOUT_S", 1.0)
    proxy = await make_proxy(ports=1)
    leases = proxy.ros1.leases
    context = proxy.ros1.context
    (port,) = context.settings.ports.listen.ports()
    trial = asyncio.create_task(probe_range(context, leases))
    await until(lambda: leases.is_lent(port), "the port is being tried")
    node = await make_node()
    assert (await node.publish(proxy.master))[0] == 1
    assert await trial == ()
    assert master.holds("publishers", "/chatter") == [proxy.uri(node)]


async def test_no_fast_port_is_tried_unasked(make_proxy: MakeProxy, make_node: MakeNode) -> None:
    proxy = await make_proxy(ports=1)
    node = await make_node()
    await node.publish(proxy.master)
    assert await probe_range(proxy.ros1.context, proxy.ros1.leases, or_fast=False) == ()
