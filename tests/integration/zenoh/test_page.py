"""The live page's document of a proxy for rmw_zenoh, from the reports of the router process.

A small program stands in for the process of the routers, which needs the zenoh library.
"""

import json
import sys
from collections.abc import AsyncIterator
from contextlib import aclosing
from pathlib import Path
from typing import Any

import pytest

from rosproxy.admin.common_status import common_status
from rosproxy.page.feed import PageWatch
from rosproxy.page.problem_ages import ProblemAges
from rosproxy.runtime import Runtime
from rosproxy.shared.connections import sockets
from rosproxy.zenoh import stack
from rosproxy.zenoh.stack import Zenoh
from tests.integration.net import PATIENCE, until
from tests.run_options import parse_settings

HOST = "127.0.2.2"
PEER = "127.0.2.8"
REPORTS = """
import sys, time
sys.stdin.readline()
while True:
    with open(sys.argv[1]) as report:
        print(report.read(), flush=True)
    time.sleep(0.05)
"""
STRING = "std_msgs::msg::dds_::String_"
NUMBER = "std_msgs::msg::dds_::Int32_"
TALKER = "0 aa.0/talker"
LISTENER = "0 bb.0/listener"
LINK = f"topic /chatter {TALKER} {LISTENER}"
ROUTER = f"router {PEER}:7447"
CHECK_ROUTER = "check the port, and give each router once"
"""The fix if a program accepts connections, and opens no session of zenoh."""


def tokens(
    session: str, node: str, kind: str, *, key_type: str = STRING, domain: int = 0
) -> list[str]:
    """The tokens of a node, and of its publisher or subscription of /chatter."""
    start = f"@ros2_lv/{domain}/{session}/0"
    entity = f"{kind}/%/%/{node}/%chatter/{key_type}/RIHS01_0/::,10:,:,:,,"
    return [f"{start}/0/NN/%/%/{node}", f"{start}/1/{entity}"]


def session(zid: str, mode: str, remote: str) -> dict[str, Any]:
    link = {"src": f"tcp/{HOST}:7448", "dst": f"tcp/{remote}"}
    return {"peer": zid, "whatami": mode, "links": [link]}


class Page:
    """A stack whose reports the test writes, and the documents of its page."""

    def __init__(self, folder: Path) -> None:
        self._report = folder / "report"
        settings = {"ros": ("zenoh",), "zenoh_ports": "47458-47459", "bind": HOST}
        self._runtime = Runtime(parse_settings({**settings, "zenoh_peer": (PEER,)}))
        self.zenoh = Zenoh(self._runtime)
        self.zenoh.supervisor.program = (sys.executable, "-c", REPORTS, str(self._report))
        self.tell([])

    def tell(self, known: list[str], *, is_linked: bool = True, left_out: int = 0) -> None:
        """Report these tokens. The talker has a session at the first port."""
        hub = [session("04", "router", f"{PEER}:7447")] if is_linked else []
        container = session("aa", "peer", "172.18.0.3:50000")
        routers = [
            {"zid": "01", "sessions": [container]},
            {"zid": "02"},
            {"zid": "03", "sessions": hub},
        ]
        report = {"routers": routers, "tokens": known, "tokens_left_out": left_out}
        written = self._report.with_suffix(".new")
        written.write_text(json.dumps(report))
        written.rename(self._report)

    def problems(self) -> str:
        """The problems that the proxy reports by itself."""
        noted = self._runtime.problems.all()
        return "; ".join(f"{problem.subject}: {problem.text}" for problem in noted)

    async def document(self, table: str, key: str, **wanted: Any) -> dict[str, Any]:
        """The first document with these values in the row of a table; None: without the key."""
        status = PageWatch(
            lambda: self.zenoh.extended_status(common_status(self._runtime)),
            tuple,
            "",
            ProblemAges(),
        )
        seen: dict[str, Any] = {}
        async with aclosing(status.documents()) as documents:
            async for document in documents:
                seen = document
                row = document[table].get(key, {})
                if all(row.get(name) == value for name, value in wanted.items()):
                    return document
                if self._runtime.uptime() > PATIENCE:
                    break
        raise AssertionError(f"{key} never had {wanted}: {seen}")


@pytest.fixture
async def page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> AsyncIterator[Page]:
    monkeypatch.setattr(stack, "_check_package", lambda: None)
    monkeypatch.setattr(stack, "LINK_INTERVAL_S", 0.05)
    monkeypatch.setattr(stack, "FAULT_INTERVAL_S", 0.05)
    monkeypatch.setattr("rosproxy.zenoh.findings.LINK_GRACE_S", 0.0)
    monkeypatch.setattr("rosproxy.page.feed.DOCUMENT_INTERVAL_S", 0.05)
    page = Page(tmp_path)
    await page.zenoh.start()
    yield page
    await page.zenoh.stop()


async def test_nodes_come_meet_and_go(page: Page) -> None:
    talker = tokens("aa", "talker", "MP")
    page.tell([*talker, *tokens("bb", "listener", "MS")])
    document = await page.document("links", LINK, state="ok", carried="router", port=47458)
    assert document["links"][LINK]["type"] == "std_msgs/msg/String"
    nodes = document["nodes"]
    assert (nodes[TALKER]["lane"], nodes[TALKER]["address"]) == ("container", "172.18.0.3")
    await page.document("nodes", LISTENER, address=f"{PEER}:7447, behind this router")
    page.tell(talker)
    document = await page.document("links", f"topic /chatter {TALKER} ", port=47458)
    assert LISTENER not in document["nodes"]
    assert LINK not in document["links"]


async def test_another_type_breaks_a_link_until_it_is_the_same(
    page: Page, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "rosproxy")
    talker = tokens("aa", "talker", "MP")
    page.tell([*talker, *tokens("bb", "listener", "MS", key_type=NUMBER)])
    document = await page.document("links", LINK, state="broken")
    assert "requests std_msgs/msg/Int32" in document["links"][LINK]["text"]
    assert not document["findings"], "the link shows the finding"
    text = "topic /chatter: type differs: the publisher /talker (172.18.0.3) offers"
    await until(lambda: text in page.problems(), page.problems)
    page.tell([*talker, *tokens("bb", "listener", "MS")])
    await page.document("links", LINK, state="ok", text=None)
    await until(lambda: not page.problems(), page.problems)
    assert caplog.text.count(text) == caplog.text.count("topic /chatter: the fault is over") == 1


async def test_another_domain_is_named(page: Page) -> None:
    page.tell([*tokens("aa", "talker", "MP"), *tokens("bb", "listener", "MS", domain=7)])
    alone = f"topic /chatter {TALKER} "
    document = await page.document("links", alone, state="warning")
    assert "/listener (outside) in domain 7" in document["links"][alone]["text"]


async def test_a_link_to_a_router_is_down_and_up_again(page: Page) -> None:
    page.tell([], is_linked=False)
    document = await page.document("nodes", ROUTER, state="broken")
    assert document["nodes"][ROUTER]["text"].startswith("connection refused")
    assert "rmw_zenohd" in document["nodes"][ROUTER]["fix"]
    router = sockets.listen(PEER, 7447)
    await page.document("nodes", ROUTER, state="broken", fix=CHECK_ROUTER)
    router.close()
    page.tell([])
    document = await page.document("nodes", ROUTER, state=None, text=None)
    assert document["nodes"][ROUTER]["detail"] == "linked with the hub of the proxy"


async def test_tokens_that_are_left_out_are_told(page: Page) -> None:
    page.tell(tokens("aa", "talker", "MP"), left_out=3)
    document = await page.document("nodes", TALKER, lane="container")
    (finding,) = document["findings"]
    assert "left out of the status: 3" in finding["text"]
