"""The stack for rmw_zenoh: obstacles to its start, and reported faults.

A small program stands in for the process of the routers, which needs the zenoh library.
"""

import sys
from collections.abc import AsyncIterator, Callable
from importlib import metadata
from pathlib import Path

import pytest

from rosproxy.admin.requests import BodyError
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.app.policy_sources import PolicySources
from rosproxy.net import sockets
from rosproxy.runtime import Runtime
from rosproxy.setting_kinds import SettingError
from rosproxy.zenoh import stack
from rosproxy.zenoh.stack import Zenoh
from tests.integration.net import until
from tests.run_options import parse_settings

HOST = "127.0.2.1"
PEER = "127.0.2.7"
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
Make = Callable[..., Zenoh]


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


async def test_posted_rules_are_refused(caplog: pytest.LogCaptureFixture) -> None:
    runtime = Runtime(parse_settings({"ros": ("zenoh",)}))
    sources = PolicySources(runtime, ())
    layer = {"name": "operator", "rules": ["deny publish /camera"]}
    with pytest.raises(BodyError, match="rules have no effect on rmw_zenoh"):
        await sources.post({"layers": [layer]})
    assert not runtime.policy.layers
    assert "rules have no effect" in runtime.problems.all()[0].text
    assert "rules have no effect" in caplog.text

    assert await sources.post({"layers": []}) == {}
    assert not runtime.problems.all()
