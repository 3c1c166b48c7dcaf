"""The stack for rmw_zenoh: obstacles to its start, and reported faults.

A small program stands in for the process of the routers, which needs the zenoh library.
"""

import json
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from rosproxy.app.policy_sources import PolicySources
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections import sockets
from rosproxy.shared.documents.requests import BodyError
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.setting_kinds import SettingError
from rosproxy.zenoh import stack, status
from rosproxy.zenoh.links import LinkFault
from rosproxy.zenoh.protocol.report import (
    Report,
    RouterReport,
    RouterSession,
    SessionConnection,
)
from rosproxy.zenoh.stack import Zenoh
from tests import certificates
from tests.integration.net import until
from tests.run_options import parse_settings

HOST = "127.0.2.1"
PEER = "127.0.2.7"
OTHER_PEER = "127.0.2.8"
REPORTS = """
import os, sys, time
sys.stdin.readline()
links = '[{"src": "tcp/1.2.3.4:5", "dst": "tcp/PEER:7447"}]'
session = '{"peer": "03", "whatami": "router", "links": %s}' % links
while True:
    sessions = session if os.path.exists(sys.argv[1]) else ""
    print('{"routers": [{"zid": "01"}, {"zid": "02", "sessions": [%s]}]}' % sessions, flush=True)
    time.sleep(0.05)
""".replace("PEER", PEER)
"""Two routers. The hub has a session with the peer while a file exists."""
CONFIRMS = """
import json, sys
for line in sys.stdin:
    with open(sys.argv[1], "a") as told:
        told.write(line)
    print(json.dumps({"revision": json.loads(line)["revision"]}), flush=True)
"""
LEADS_BACK = """
import json, sys
for line in sys.stdin:
    with open(sys.argv[1], "a") as told:
        told.write(line)
    given = json.loads(line)
    hub = {"zid": "02", "sessions": []}
    for endpoint in json.loads(given["routers"][-1]["connect/endpoints"]):
        if endpoint == "tcp/192.0.2.7:47448":
            ends = {"src": "tcp/172.18.0.2:50000", "dst": endpoint}
            hub["sessions"].append({"peer": "01", "whatami": "router", "links": [ends]})
    print(json.dumps({"revision": given["revision"], "routers": [{"zid": "01"}, hub]}), flush=True)
"""
"""The hub reaches another router of the proxy at a peer, as through the address of a Service."""
FORGETS = """
import json, sys
for line in sys.stdin:
    with open(sys.argv[1], "a") as told:
        told.write(line)
    given = json.loads(line)
    dialed = json.loads(given["routers"][-1]["connect/endpoints"])[int(sys.argv[2])]
    log = "DEBUG zenoh::net::runtime::orchestrator: Successfully connected to configured peer"
    print(log, dialed, file=sys.stderr, flush=True)
    routers = [{"zid": "01"}, {"zid": "02"}]
    print(json.dumps({"revision": given["revision"], "routers": routers}), flush=True)
"""
"""The hub has connected to one of its two endpoints, and never dials this endpoint again."""
Make = Callable[..., Zenoh]
AUTHORITY = certificates.Authority()


@pytest.fixture
async def make(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> AsyncIterator[Make]:
    """Makes stacks whose hub has a session with the peer while the file `linked` exists."""
    made: list[Zenoh] = []
    monkeypatch.setattr(stack, "_check_package", lambda: None)
    monkeypatch.setattr(stack, "LINK_INTERVAL_S", 0.05)
    monkeypatch.setattr(stack, "FAULT_INTERVAL_S", 0.05)

    def make(**options: object) -> Zenoh:
        given = {"ros": ("zenoh",), "zenoh_ports": "47448-47448", "bind": HOST, **options}
        zenoh = Zenoh(Runtime(parse_settings(given)))
        zenoh.supervisor.program = (sys.executable, "-c", REPORTS, str(tmp_path / "linked"))
        made.append(zenoh)
        return zenoh

    yield make
    for zenoh in made:
        await zenoh.stop()


async def test_without_the_package_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(name: str) -> metadata.Distribution:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", missing)
    zenoh = Zenoh(Runtime(parse_settings({"ros": ("zenoh",)})))
    expected = "--ros zenoh: needs the package eclipse-zenoh. Install rosproxy.zenoh."
    for start in (zenoh.start, zenoh.try_ports):
        with pytest.raises(SettingError, match=expected):
            await start()


@pytest.mark.parametrize(("port", "option"), [(47448, "--zenoh-ports"), (47447, "--zenoh-listen")])
async def test_a_taken_port_is_named_with_its_option(make: Make, port: int, option: str) -> None:
    zenoh = make(zenoh_listen=47447)
    taken = sockets.listen(HOST, port)
    with pytest.raises(SettingError, match=f"{option}: port {port} can't be bound") as caught:
        await zenoh.start()
    assert "ss -ltunp" in str(caught.value)
    taken.close()


async def test_a_fault_is_told_until_it_is_over(
    make: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setattr("rosproxy.zenoh.findings.LINK_GRACE_S", 0.0)
    zenoh = make(zenoh_peer=(PEER,))
    await zenoh.start()
    assert zenoh.unready() is None
    problems = zenoh._runtime.problems

    def told() -> str:
        return "; ".join(f"{problem.subject}: {problem.text}" for problem in problems.all())

    refused = f"zenoh peer {PEER}:7447: connection refused: no router listens there"
    await until(lambda: refused in told(), told)
    router = sockets.listen(PEER, 7447)
    await until(lambda: "zenoh opens no session" in told(), told)
    router.close()
    (tmp_path / "linked").touch()
    await until(lambda: not problems.all(), told)
    status = zenoh.extended_status(ProxyStatus()).zenoh
    assert status is not None
    assert status.links[0].up
    assert caplog.text.count("zenoh opens no session") == 1


@pytest.fixture
def lines(tmp_path: Path) -> Callable[[], list[dict[str, Any]]]:
    """The configurations that the process of the routers has got, of all its lines."""

    def read() -> list[dict[str, Any]]:
        told = tmp_path / "told"
        texts = told.read_text().splitlines() if told.exists() else []
        return [json.loads(text) for text in texts]

    return read


Lines = Callable[[], list[dict[str, Any]]]


def with_confirming_process(zenoh: Zenoh, tmp_path: Path) -> Zenoh:
    """The stack, with a process that notes and confirms each line."""
    zenoh.supervisor.program = (sys.executable, "-c", CONFIRMS, str(tmp_path / "told"))
    return zenoh


def layer(*rules: str) -> dict[str, object]:
    return {"layers": [{"name": "operator", "rules": rules}]}


async def test_posted_rules_are_in_force_when_the_proxy_answers(
    make: Make, tmp_path: Path, lines: Lines
) -> None:
    zenoh = with_confirming_process(make(), tmp_path)
    await zenoh.start()
    sources = PolicySources(zenoh._runtime, (zenoh,))
    await sources.post(layer("deny publish /camera"))
    await sources.post(layer("deny publish /camera"))  # changes nothing
    await sources.post({"layers": []})
    routers = [line["routers"] for line in lines()]
    assert ["access_control" in router for router, _ in routers] == [False, True, False]
    assert not any("access_control" in hub for _, hub in routers)
    assert "*/camera/*/*" in routers[1][0]["access_control"]


def peers_of_hub(line: dict[str, Any]) -> list[str]:
    endpoints = json.loads(line["routers"][-1]["connect/endpoints"])
    return [endpoint for endpoint in endpoints if endpoint.startswith("tcp/")]


async def test_the_hub_does_not_dial_routers_of_the_proxy_as_peers(
    make: Make, tmp_path: Path, lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At such a port the hub counted as a node, for which no rules hold."""
    monkeypatch.setattr("rosproxy.zenoh.findings.LINK_GRACE_S", 0.0)
    peers = (f"{HOST}:47448", "localhost:47448", PEER)
    zenoh = with_confirming_process(make(zenoh_peer=peers), tmp_path)
    await zenoh.start()
    assert peers_of_hub(lines()[0]) == [f"tcp/{PEER}:7447"]
    problems = zenoh._runtime.problems
    subject = f"zenoh peer {HOST}:47448"
    await until(lambda: subject in {p.subject for p in problems.all()}, "the fault is told")
    texts = {problem.subject: problem.text for problem in problems.all()}
    assert texts[subject].startswith("the address leads to a router of this proxy")


async def test_a_peer_that_turns_out_to_be_the_proxy_is_left_out(
    make: Make, tmp_path: Path, lines: Lines
) -> None:
    zenoh = make(zenoh_peer=("192.0.2.7:47448", PEER))
    zenoh.supervisor.program = (sys.executable, "-c", LEADS_BACK, str(tmp_path / "told"))
    await zenoh.start()
    await until(lambda: len(lines()) == 2, "the routers have other configurations")
    assert peers_of_hub(lines()[0]) == ["tcp/192.0.2.7:47448", f"tcp/{PEER}:7447"]
    assert peers_of_hub(lines()[1]) == [f"tcp/{PEER}:7447"]


@pytest.mark.parametrize("endpoint", [0, 1], ids=["router of a container", "peer"])
async def test_the_hub_is_opened_anew_if_it_dials_no_more(
    make: Make, tmp_path: Path, lines: Lines, monkeypatch: pytest.MonkeyPatch, endpoint: int
) -> None:
    """No message passed any more until the proxy was restarted (zenoh 1.7.2)."""
    monkeypatch.setattr("rosproxy.zenoh.redialing.GRACE_S", 0.0)
    zenoh = make(zenoh_peer=(PEER,))
    program = (sys.executable, "-c", FORGETS, str(tmp_path / "told"), str(endpoint))
    zenoh.supervisor.program = program
    await zenoh.start()
    await until(lambda: len(lines()) == 2, "the hub is opened anew")
    (router, hub), (same_router, other_hub) = (line["routers"] for line in lines())
    assert router == same_router
    assert hub != other_hub


@pytest.mark.parametrize("is_silent", [True, False])
async def test_a_session_with_a_former_address_ends_if_no_router_answers_there(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_silent: bool
) -> None:
    addresses = (PEER,)

    async def resolved(host: str) -> tuple[str, ...]:
        return addresses

    monkeypatch.setattr(stack, "resolve", resolved)
    ended: list[HostPort] = []
    zenoh = make(zenoh_peer=("robot",))
    monkeypatch.setattr(zenoh.supervisor, "end_connections", ended.extend)
    (tmp_path / "linked").touch()
    await zenoh.start()
    (link,) = zenoh.state.links
    await until(lambda: link.fault is None, "the link is up")
    listeners = [sockets.listen(OTHER_PEER, 7447)]
    if not is_silent:
        listeners.append(sockets.listen(PEER, 7447))
    addresses = (OTHER_PEER,)
    await until(lambda: link.fault is LinkFault.MOVED, "the fault is known")
    if is_silent:
        await until(lambda: ended[:1] == [HostPort(PEER, 7447)], "the session ends")
    assert is_silent or not ended
    for listener in listeners:
        listener.close()


async def test_rules_of_a_changed_file_come_into_force(
    make: Make, tmp_path: Path, lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stack, "POLICY_INTERVAL_S", 0.05)
    zenoh = with_confirming_process(make(), tmp_path)
    await zenoh.start()
    rules = parse_rules("deny serve /arm")
    zenoh._runtime.policy.use_file(PolicyLayer("file", rules))
    await until(lambda: len(lines()) == 2, "the routers have the rules")
    assert "*/arm/*/*" in lines()[1]["routers"][0]["access_control"]


async def test_posted_rules_that_routers_can_not_have_are_refused(
    make: Make, tmp_path: Path, lines: Lines, caplog: pytest.LogCaptureFixture
) -> None:
    """The former rules stay in force."""
    zenoh = with_confirming_process(make(), tmp_path)
    await zenoh.start()
    runtime = zenoh._runtime
    sources = PolicySources(runtime, (zenoh,))
    await sources.post(layer("deny publish /camera"))
    with pytest.raises(BodyError, match=r"rmw_zenoh has no [?]"):
        await sources.post(layer("deny publish /c?"))
    assert runtime.policy.layers[0].rules == parse_rules("deny publish /camera")
    assert "rmw_zenoh has no ?" in runtime.problems.all()[0].text
    assert "rmw_zenoh has no ?" in caplog.text
    assert len(lines()) == 2


async def test_options_that_routers_can_not_have_are_refused(make: Make) -> None:
    zenoh = make(policy="allow publish /a/b; deny publish /a/*")
    for start in (zenoh.start, zenoh.try_ports):
        with pytest.raises(SettingError, match=r"--policy: layer '--policy': .*except /a/b"):
            await start()


async def test_rules_need_a_directory_for_sockets(
    make: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, lines: Lines
) -> None:
    """Without a directory the hub dials by TCP, and a router cannot tell the hub from nodes."""
    monkeypatch.setattr(stack, "make_socket_directory", lambda: "")
    with pytest.raises(SettingError, match="Mount a tmpfs at /dev/shm"):
        await make(policy="deny publish *").start()
    zenoh = with_confirming_process(make(), tmp_path)
    await zenoh.start()
    with pytest.raises(BodyError, match="Mount a tmpfs at /dev/shm"):
        await PolicySources(zenoh._runtime, (zenoh,)).post(layer("deny publish *"))
    assert "unixsock" not in json.dumps(lines())


async def test_no_router_runs_before_the_policy_of_an_operator(
    make: Make, tmp_path: Path, lines: Lines
) -> None:
    zenoh = with_confirming_process(make(await_policy=3600.0), tmp_path)
    await zenoh.start()
    assert "have not started yet" in (zenoh.unready() or "")
    assert not lines()
    await PolicySources(zenoh._runtime, (zenoh,)).post(layer("deny publish /camera"))
    await until(lambda: zenoh.unready() is None, "the routers run")
    assert ["access_control" in line["routers"][0] for line in lines()] == [True]


async def test_the_directory_goes_with_the_proxy(make: Make, tmp_path: Path, lines: Lines) -> None:
    zenoh = with_confirming_process(make(), tmp_path)
    await zenoh.start()
    endpoint = json.loads(lines()[0]["routers"][0]["listen/endpoints"])[1]
    directory = Path(endpoint.removeprefix("unixsock-stream/")).parent
    assert directory.is_dir()
    assert directory.stat().st_mode & 0o077 == 0
    await zenoh.stop()
    assert not directory.exists()


async def test_tokens_are_read_while_the_event_loop_serves_others(make: Make) -> None:
    """To read 8,192 tokens takes 0.2 s, and a session can change a token each second."""
    zenoh = make()
    readers = list[int]()

    class Tokens(tuple[str, ...]):
        def __iter__(self) -> Iterator[str]:
            readers.append(threading.get_ident())
            return super().__iter__()

    zenoh.supervisor.failure = ""
    await zenoh._take_report(Report(tokens=Tokens(["@ros2_lv/0/bb/0/0/NN/%/%/robot"])))
    assert [node.name for node in zenoh.state.status().nodes] == ["/robot"]
    assert readers
    assert threading.get_ident() not in readers


async def test_rows_and_pairs_are_made_while_the_event_loop_serves_others(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For 8,192 nodes, these took 0.3 s each second."""
    makers = list[int]()

    def seen(made: Callable[..., object]) -> Callable[..., object]:
        def make_row(*arguments: object, **options: object) -> object:
            makers.append(threading.get_ident())
            return made(*arguments, **options)

        return make_row

    for maker in ("compare", "ZenohNodeStatus", "InsideName"):
        monkeypatch.setattr(status, maker, seen(getattr(status, maker)))
    zenoh = make()
    zenoh.supervisor.failure = ""
    await zenoh._take_report(inside_report())
    assert len(makers) == 3
    assert zenoh.extended_status(ProxyStatus()).zenoh
    await zenoh._look_for_faults()
    await zenoh._look_at_policy()
    assert threading.get_ident() not in makers


async def test_tokens_after_many_tokens_wait(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    zenoh = make()
    zenoh.supervisor.failure = ""
    times = iter([10.0, 10.5, 14.9, 15.1, 15.1])
    monkeypatch.setattr(zenoh._runtime, "now", lambda: next(times))
    await zenoh._take_report(Report(tokens=("@ros2_lv/0/bb/0/0/NN/%/%/robot",)))
    await zenoh._take_report(Report(tokens=("@ros2_lv/0/bb/0/0/NN/%/%/other",)))
    assert [node.name for node in zenoh.state.status().nodes] == ["/robot"]
    await zenoh._take_report(Report())
    assert [node.name for node in zenoh.state.status().nodes] == ["/other"]


def inside_report() -> Report:
    """A report with a node at a port for containers."""
    ends = (SessionConnection(f"tcp/{HOST}:47448", "tcp/172.18.0.3:50000"),)
    routers = (RouterReport("01", (RouterSession("aa", "peer", ends),)), RouterReport("02"))
    start = "@ros2_lv/0/aa/0"
    entity = f"{start}/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/RIHS01_0/::,10:,:,:,,"
    return Report(routers, (f"{start}/0/NN/%/%/talker", entity))


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with the files of a link to another site."""
    return AUTHORITY.write(tmp_path / "files")


def linked(make: Make, files: Path, **options: object) -> Zenoh:
    return make(zenoh_link=("tls/127.0.2.7",), **certificates.options(files), **options)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"zenoh_ca": "/no/ca"}, "--zenoh-ca: /no/ca can't be read: No such file or directory"),
        ({"zenoh_limit": "/a*b=2"}, "--zenoh-limit: /a.b=2Hz: write . for whole parts"),
        (
            {"zenoh_link_policy": "allow publish /a/b; deny publish /a/*"},
            "--zenoh-link-policy: layer '--zenoh-link-policy': .*except /a/b",
        ),
    ],
)
async def test_links_that_can_not_be_are_refused_at_the_start(
    make: Make, files: Path, options: dict[str, str], complaint: str
) -> None:
    given = {**certificates.options(files), **options}
    zenoh = make(zenoh_link=("tls/127.0.2.7",), **given)
    for start in (zenoh.start, zenoh.try_ports):
        with pytest.raises(SettingError, match=complaint):
            await start()


async def test_without_its_files_a_proxy_of_an_operator_runs_without_links(
    make: Make,
    files: Path,
    tmp_path: Path,
    lines: Lines,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A Secret may come later."""
    monkeypatch.setattr(stack, "CHECK_INTERVAL_S", 0.05)
    volume = tmp_path / "volume"
    volume.mkdir()
    zenoh = with_confirming_process(linked(make, volume, zenoh_await_files=True), tmp_path)
    assert not await zenoh.try_ports()
    await zenoh.start()
    problems = zenoh._runtime.problems

    def told() -> str:
        return "; ".join(f"{problem.subject}: {problem.text}" for problem in problems.all())

    await until(lambda: "the proxy has no links to other sites" in told(), told)
    assert told().startswith(f"zenoh file {volume / certificates.CERTIFICATE}: can't be read: No")
    await zenoh._look_at_links()
    (link,) = zenoh.state.links
    assert link.fault is LinkFault.NOT_TRIED
    certificates.mount(volume, files)
    await until(lambda: len(lines()) == 2, "the routers have the files")
    before, after = (line["routers"] for line in lines())
    assert [one == other for one, other in zip(before, after, strict=True)] == [True, False, True]
    assert "127.0.2.7" not in str(before[1])
    assert "tls/127.0.2.7:7447" in after[1]["connect/endpoints"]
    await until(lambda: not told(), told)


async def test_links_need_a_directory_for_sockets(
    make: Make, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stack, "make_socket_directory", lambda: "")
    with pytest.raises(SettingError, match="--zenoh-link: links to other sites need a directory"):
        await linked(make, files).start()


async def test_new_files_restart_the_router_of_links_alone(
    make: Make,
    files: Path,
    tmp_path: Path,
    lines: Lines,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A mounted Secret changes by a symlink. Bad files change nothing, and are told."""
    caplog.set_level("INFO")
    monkeypatch.setattr(stack, "CHECK_INTERVAL_S", 0.05)
    volume = tmp_path / "volume"
    certificates.mount(volume, files)
    zenoh = with_confirming_process(linked(make, volume), tmp_path)
    await zenoh.start()
    assert "other sites tls/127.0.2.7:7447" in zenoh.greeting
    certificates.mount(volume, AUTHORITY.write(tmp_path / "second"))
    await until(lambda: len(lines()) == 2, "the routers have the new files")
    before, after = (line["routers"] for line in lines())
    assert [one == other for one, other in zip(before, after, strict=True)] == [True, False, True]
    assert "were read again" in caplog.text
    bad = AUTHORITY.write(tmp_path / "third")
    (bad / certificates.KEY).write_bytes((files / certificates.KEY).read_bytes())
    certificates.mount(volume, bad)
    problems = zenoh._runtime.problems

    def told() -> str:
        return "; ".join(f"{problem.subject}: {problem.text}" for problem in problems.all())

    key = volume / certificates.KEY
    expected = f"zenoh file {key}: does not belong to the certificate. "
    await until(lambda: expected in told(), told)
    assert "The files that were read before stay in use" in told()
    certificates.mount(volume, AUTHORITY.write(tmp_path / "fourth"))
    await until(lambda: len(lines()) == 3, "the routers have the new files")
    await until(lambda: "does not belong" not in told(), told)
    assert not zenoh._sites.look(), "nothing has changed"


async def test_the_certificate_of_hubs_is_told_before_its_end(
    make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = AUTHORITY.write(tmp_path / "hub", HOST, ends=10 * certificates.DAY)
    parts = (certificates.KEY, certificates.CERTIFICATE, certificates.CA)
    text = "".join((folder / name).read_text() for name in parts)
    zenoh = make(zenoh_hub_listen=47449, zenoh_hub_certificate=text)
    await zenoh.start()
    problems = zenoh._runtime.problems
    await until(lambda: "zenoh certificate of hubs" in caplog.text, lambda: caplog.text)
    (problem,) = problems.all()
    assert problem.text.startswith("expires within 14 days. Fix: give all proxies of the graph a")
    (life,) = zenoh.state.status().certificates
    assert life.ends_in
    metrics = {metric.name: metric for metric in zenoh.state.collect()}
    (sample,) = metrics["rosproxy_zenoh_certificate_expiry_seconds"].samples
    assert sample.labels == {"file": "--zenoh-hub-certificate"}
    assert sample.value > life.ends_in


async def test_a_foreign_certificate_of_another_site_is_told(make: Make, files: Path) -> None:
    zenoh = linked(make, files, zenoh_link_listen="tls/47449")
    zenoh._refuse("is of a CA that this proxy does not trust")
    (problem,) = zenoh._runtime.problems.all()
    assert problem.subject == "refused: link certificate"
    assert problem.text.startswith(
        "from a connection to tls/47449: the certificate is of a CA that this proxy does not trust"
    )


async def test_a_name_counts_as_not_judged_until_it_is_compared_with_the_rules(make: Make) -> None:
    zenoh = make(policy="deny publish /chatter")
    zenoh.supervisor.failure = ""
    await zenoh._take_report(inside_report())
    zenoh._policy.access()

    def told() -> tuple[bool, int]:
        status = zenoh.extended_status(ProxyStatus())
        assert status.zenoh
        assert status.policy
        return status.zenoh.nodes[0].not_judged, len(status.policy.hidden)

    assert told() == (True, 0)
    zenoh._policy.look(zenoh.state.inside_names())
    assert told() == (False, 1)
