"""``rosproxy status`` and ``rosproxy health``, and how commands meet a proxy that isn't there."""

import asyncio
import fcntl
import json
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager

import pytest

from examples.demo.fake_http import FakeHttpServer, FakeRequest, ok
from examples.demo.fake_node import FakeNode
from examples.demo.proxy_process import clean_environment
from rosproxy.shared.http.admin_client import AdminClient, default_url
from tests.integration.commands import admin_url, run
from tests.integration.net import HOST, connect, read_header, topic_header, until
from tests.integration.proxy import Proxy

NOBODY = "http://127.0.0.1:1"


@pytest.fixture
async def stranger() -> AsyncIterator[str]:
    """A web server that is no rosproxy."""

    async def respond(request: FakeRequest) -> bytes:
        return ok(b'{"hello": "world"}')

    fake = FakeHttpServer(respond)
    await fake.start("127.0.0.1")
    yield f"http://127.0.0.1:{fake.address[1]}"
    await fake.stop()


async def test_status_as_a_table(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master)
    async with connect(proxy.lease(node)) as wire:
        await wire.send(topic_header())
        await read_header(wire)
        result = await run("status", "--admin", admin_url(proxy))
    assert (result.code, result.err) == (0, "")
    row = next(line for line in result.out.splitlines() if line.startswith("/talker"))
    port = proxy.settings.ports.listen.first
    assert row.split()[1:7] == [
        str(proxy.endpoint(node).slave),
        f"{HOST}:{port}",
        "ok",
        "1",
        "0",
        "0",
    ]
    assert "publishes  /chatter" in result.out
    assert "topic /chatter with /outside at " in result.out


async def test_status_as_json(proxy: Proxy, node: FakeNode) -> None:
    await node.publish(proxy.master)
    result = await run("status", "--json", ROSPROXY_ADMIN=admin_url(proxy))
    assert (result.code, result.err) == (0, "")
    assert json.loads(result.out)["nodes"][0]["nodes"] == ["/talker"]


async def test_the_admin_endpoint_is_where_the_proxys_variable_says(proxy: Proxy) -> None:
    bound = f"0.0.0.0:{proxy.settings.admin.port}"
    assert (await run("health", ROSPROXY_ADMIN_BIND=bound)).code == 0


@pytest.mark.parametrize(
    ("bound", "url"),
    [
        ("", "http://127.0.0.1:11312"),
        ("nonsense", "http://127.0.0.1:11312"),
        ("0.0.0.0:9000", "http://127.0.0.1:9000"),
        ("[::]:9000", "http://[::1]:9000"),
        ("10.0.0.1:9000", "http://10.0.0.1:9000"),
    ],
)
def test_default_url(bound: str, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROSPROXY_ADMIN_BIND", bound)
    assert default_url() == url


@pytest.mark.parametrize("url", ["127.0.0.1:9000", "http://127.0.0.1:9000/"])
def test_urls_that_are_understood(url: str) -> None:
    assert AdminClient(url).url == "http://127.0.0.1:9000"


@pytest.mark.parametrize("url", ["", "nonsense", "https://x:1", "http://x", "x:99999"])
def test_urls_that_are_not(url: str) -> None:
    with pytest.raises(ValueError, match="is not of the form"):
        AdminClient(url)


async def test_health(proxy: Proxy) -> None:
    result = await run("health", "--admin", admin_url(proxy))
    assert (result.code, result.out, result.err) == (0, "", "")


async def test_health_heeds_no_web_proxy(proxy: Proxy) -> None:
    result = await run("health", "--admin", admin_url(proxy), http_proxy="http://127.0.0.1:1")
    assert result.code == 0


@pytest.mark.parametrize("words", [("health",), ("status",), ("status", "--json")])
async def test_nobody_answers(words: tuple[str, ...]) -> None:
    result = await run(*words, "--admin", NOBODY)
    assert (result.code, result.out) == (1, "")
    (line,) = result.err.splitlines()
    assert line.startswith(f"rosproxy: no rosproxy answers at {NOBODY} (connection refused).")
    assert "--admin http://HOST:PORT or ROSPROXY_ADMIN" in line


async def test_somebody_else_answers(stranger: str) -> None:
    result = await run("status", "--admin", stranger)
    assert result.code == 1
    assert result.err == (
        f"rosproxy: the program at {stranger} is not the admin endpoint of a rosproxy\n"
    )


async def test_health_of_an_endpoint_that_says_no() -> None:
    """An admin endpoint of something else, that has no /healthz."""

    async def respond(request: FakeRequest) -> bytes:
        return b"HTTP/1.1 404 Not Found\r\nContent-Length: 4\r\n\r\nnope"

    fake = FakeHttpServer(respond)
    await fake.start("127.0.0.1")
    result = await run("health", "--admin", f"http://127.0.0.1:{fake.address[1]}")
    await fake.stop()
    assert result.code == 1
    assert "/healthz answers HTTP 404: nope" in result.err


@pytest.mark.parametrize(
    "words",
    [
        ("status", "--json", "--watch"),
        ("status", "--open", "--watch"),
        ("status", "--admin", "nonsense"),
        ("health", "extra"),
        ("nothing",),
    ],
)
async def test_usage(words: tuple[str, ...]) -> None:
    result = await run(*words)
    assert (result.code, result.out) == (2, "")
    assert "Traceback" not in result.err


async def test_names_cannot_reach_the_terminal(proxy: Proxy, node: FakeNode) -> None:
    node.name = "/evil\u202e\u200b"
    await node.publish(proxy.master)
    for words in (("status",), ("status", "--json")):
        result = await run(*words, ROSPROXY_ADMIN=admin_url(proxy))
        assert all(line.isprintable() for line in result.out.splitlines()), words
        assert "u202e" in result.out


async def test_a_terminal_without_unicode(proxy: Proxy, node: FakeNode) -> None:
    node.name = "/名"
    await node.publish(proxy.master)
    result = await run(
        "status", ROSPROXY_ADMIN=admin_url(proxy), PYTHONIOENCODING="ascii", PYTHONUTF8="0"
    )
    assert result.code == 0
    assert "/\\u540d" in result.out


class Terminal:
    """A command in a terminal of 80 columns. ``text`` is the output so far."""

    def __init__(self, *words: str) -> None:
        self.text = ""
        self._mine, its = pty.openpty()
        fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        os.set_blocking(self._mine, False)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rosproxy", *words],
            stdin=its,
            stdout=its,
            stderr=its,
            env=clean_environment(TERM="xterm", COLUMNS="", LINES=""),
        )
        os.close(its)

    def read(self) -> str:
        """The output so far."""
        try:
            while chunk := os.read(self._mine, 65536):
                self.text += chunk.decode()
        except OSError:  # no output yet, or the command has ended
            pass
        return self.text

    async def interrupt(self) -> int:
        """Press Ctrl-C. Return the exit code."""
        self._process.send_signal(signal.SIGINT)
        await until(lambda: self.read() and self._process.poll() is not None, "the command ends")
        return self._process.wait()

    def close(self) -> None:
        """Kill the command if necessary."""
        self._process.kill()
        self._process.wait()
        os.close(self._mine)


@contextmanager
def terminal(*words: str) -> Iterator[Terminal]:
    """A command in a terminal, ended at last."""
    started = Terminal(*words)
    try:
        yield started
    finally:
        started.close()


async def test_watch_draws_until_interrupted(proxy: Proxy, node: FakeNode) -> None:
    with terminal("status", "--watch", "--admin", admin_url(proxy)) as screen:
        await until(lambda: "No node has registered" in screen.read(), "the first drawing")
        await node.publish(proxy.master)
        await until(lambda: "/talker" in screen.read(), "the next drawing")
        await proxy.stop()
        await until(lambda: "no rosproxy answers" in screen.read(), "the proxy was missed")
        assert await screen.interrupt() == 0
    assert "\x1b[?1049h" in screen.text  # enters and leaves the alternate screen
    assert "\x1b[?1049l" in screen.text
    assert "Traceback" not in screen.text


async def test_watch_into_a_file_has_no_control_characters(proxy: Proxy) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rosproxy", "status", "--watch", "--admin", admin_url(proxy)),
        stdout=asyncio.subprocess.PIPE,
        env=clean_environment(),
    )
    assert process.stdout
    text = (await process.stdout.readuntil(b"registered through")).decode()
    process.send_signal(signal.SIGINT)
    rest, _ = await process.communicate()
    assert process.returncode == 0
    assert "\x1b" not in text + rest.decode()


async def test_help_names_the_exit_codes_and_variables() -> None:
    for command, phrases in (
        ("status", ["--watch", "ROSPROXY_ADMIN_BIND"]),
        ("doctor", ["--outside", "Exits with 0"]),
        ("health", ["container health checks"]),
    ):
        result = await run(command, "--help")
        assert result.code == 0
        assert all(phrase in " ".join(result.out.split()) for phrase in phrases)


async def test_health_starts_fast() -> None:
    """Docker runs ``rosproxy health`` every few seconds, so this command must load few modules."""
    code = (
        "import sys; sys.argv = ['rosproxy', 'health', '--admin', '127.0.0.1:1']\n"
        "from rosproxy.cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'aiohttp', 'asyncio', 'prometheus_client', 'urllib.request'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", code),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    out, _ = await process.communicate()
    assert out.decode() == "[]\n"
