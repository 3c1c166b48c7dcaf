"""``rosproxy run``: options, environment variables, start and end."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import AsyncExitStack, suppress
from typing import Any

import pytest

from examples.demo.fake_http import Address, End, host_and_port
from examples.demo.proxy_process import clean_environment
from rosproxy.shared.setting_kinds import SettingError
from tests import certificates
from tests.certificates import Authority
from tests.integration.net import (
    HOST,
    MASTER,
    NODE,
    connect,
    exchange,
    post,
    read_header,
    rpc,
    topic_header,
    until,
    xml,
)
from tests.integration.process import Process, command_line
from tests.integration.proxy import Proxy, options_for, settings_for

GOOD = {"master_uri": "http://robot:11311", "advertise_host": "host"}
BAD = {
    "master_uri": [
        "robot",
        "http://robot",
        "https://robot:11311",
        "http://robot:99999",
        "http://:1",
    ],
    "advertise_host": ["", "a b", "http://host", "host:80", "a/b"],
    "master_port": ["0", "65536", "abc", "-1"],
    "port_range": ["", "5", "5-", "5-4", "0-5", "65000-70000", "a-b", "1-2-3"],
    "advertise_port_range": ["5-4", "11000-11009", "x"],
    "publish_master": ["0", "65536", "abc", "11311"],
    "bind": ["host", "1.2.3", "127.0.0.1:80"],
    "admin_bind": ["11312", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:x", ":80", "127.0.0.1:11005"],
    "inside_network": ["10.0.0.1/8", "10.0.0.0/33", "net"],
    "probe_interval": ["0", "-1", "x", "nan", "inf", "1e9"],
    "probe_timeout": ["0", "-1", "x"],
    "cleanup_after": ["-1", "x", "nan"],
    "linger": ["-1", "x"],
    "master_interval": ["0", "x"],
    "slave_control": ["none", "MASTER"],
    "policy": ["deny", "deny publish camera", "allow publish /a; deny it"],
    "policy_mode": ["off"],
    "policy_layers": ["{", "{}", '[{"name": "a"}]', "[" * 100_000],
    "log_format": ["xml"],
    "log_level": ["loud"],
}
ENVIRONMENT = {"master_uri": "ROS_MASTER_URI", "inside_network": "ROSPROXY_INSIDE_NETWORKS"}


def variable(option: str) -> str:
    return ENVIRONMENT.get(option, f"ROSPROXY_{option.upper()}")


def run(options: dict[str, Any], **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run ``rosproxy run`` until the process ends."""
    return subprocess.run(
        command_line(options),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=clean_environment(**environment),
    )


def command(arguments: list[str], **environment: str) -> tuple[int, str]:
    """Exit code and standard error of the command line, run in this process."""
    from click.testing import CliRunner

    from rosproxy.cli.main import main

    unset = dict.fromkeys(k for k in os.environ if k.startswith(("ROS_", "ROSPROXY_")))
    result = CliRunner().invoke(main, arguments, env={**unset, **environment})
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.stderr


@pytest.fixture(autouse=True)
def _no_logging(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line run in this process must not take the tests' log away."""
    monkeypatch.setattr("rosproxy.shared.output.logs.set_up", lambda *_: None)


def arguments(options: dict[str, Any]) -> list[str]:
    return [*command_line(options)[3:], "--check"]


@pytest.mark.parametrize("option", BAD)
def test_a_bad_value_ends_with_2_and_one_line_that_names_the_option(option):
    name = "--" + option.replace("_", "-")
    for bad in BAD[option]:
        code, text = command(arguments({**GOOD, option: bad}))
        assert (code, text.count("\n")) == (2, 1), (bad, text)
        assert name in text, (bad, text)
        code, text = command(
            arguments({k: v for k, v in GOOD.items() if k != option}), **{variable(option): bad}
        )
        if bad:  # an empty variable counts as unset
            assert (code, text.count("\n")) == (2, 1), (bad, text)
            assert name in text, (bad, text)


@pytest.mark.parametrize("option", GOOD)
def test_what_is_required_is_named(option):
    code, text = command(arguments({k: v for k, v in GOOD.items() if k != option}))
    assert (code, text.count("\n")) == (2, 1)
    assert "--" + option.replace("_", "-") in text
    assert variable(option) in text


def test_an_unknown_option_is_named_in_one_line():
    code, text = command([*arguments(GOOD), "--bogus"])
    assert (code, text.count("\n"), "--bogus" in text) == (2, 1, True)


def test_check_accepts_good_values_from_the_command_line_and_the_environment():
    good = {
        **GOOD,
        "master_port": "11411",
        "port_range": "45000-45009",
        "advertise_port_range": "46000-46009",
        "publish_master": "11311",
        "bind": "::",
        "admin_bind": "[::1]:11312",
        "inside_network": "10.0.0.0/8 fd00::/8",
        "probe_interval": "0.5",
        "probe_timeout": "1",
        "cleanup_after": "0",
        "linger": "0",
        "master_interval": "1",
        "slave_control": "master",
        "policy": "allow publish /odom; deny publish *",
        "policy_mode": "audit",
        "policy_layers": '[{"name": "web", "rules": ["deny serve *"], "mode": "enforce"}]',
        "log_format": "json",
        "log_level": "DEBUG",
    }
    assert set(good) == set(BAD)
    on_line = {**good, "inside_network": tuple(good["inside_network"].split())}
    assert command(arguments(on_line)) == (0, "")
    assert command(["run", "--check"], **{variable(k): v for k, v in good.items()}) == (0, "")


def test_check_reads_the_files_of_links_between_sites(tmp_path):
    files = certificates.options(Authority().write(tmp_path / "site"))
    given = {"ros": "zenoh", "zenoh_link": "tls/cloud.example", **files}
    assert command(arguments(given)) == (0, "")
    (tmp_path / "site" / certificates.CA).unlink()
    code, text = command(arguments(given))
    assert (code, text.count("\n")) == (2, 1)
    assert f"--zenoh-ca: {tmp_path}/site/ca.crt can't be read: No such file" in text


def test_the_command_line_wins_over_the_environment():
    assert command(arguments(GOOD), ROSPROXY_ADVERTISE_HOST="a b") == (0, "")


@pytest.mark.parametrize(
    ("option", "clash"),
    [("master_port", "port_range"), ("admin_bind", "port_range"), ("publish_master", "port_range")],
)
def test_ports_that_overlap_are_told(option, clash):
    value = "127.0.0.1:11005" if option == "admin_bind" else "11005"
    code, text = command(arguments({**GOOD, option: value}))
    assert (code, text.count("\n")) == (2, 1)
    assert "--" + option.replace("_", "-") in text
    assert "--" + clash.replace("_", "-") in text


def test_check_binds_nothing():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert command(arguments({**GOOD, "master_port": port, "bind": "127.0.0.1"})) == (0, "")


@pytest.mark.parametrize("option", ["master_port", "publish_master", "admin_bind", "port_range"])
def test_a_taken_port_ends_with_2_and_one_line_that_names_the_option(option):
    with socket.create_server(("0.0.0.0", 0)) as server:
        port = server.getsockname()[1]
        taken = {"admin_bind": f"127.0.0.1:{port}", "port_range": f"{port}-{port}"}
        ended = run(options_for(**{**GOOD, option: taken.get(option, port)}))
    assert (ended.returncode, ended.stdout) == (2, "")
    (line,) = [text for text in ended.stderr.splitlines() if text.startswith("rosproxy: ")]
    assert "--" + option.replace("_", "-") in line
    assert str(port) in line
    assert "Traceback" not in ended.stderr


async def test_an_address_of_another_machine_is_told_for_what_it_is():
    proxy = Proxy(settings_for(**GOOD, bind="192.0.2.1"))
    with pytest.raises(SettingError, match=r"--bind: 192\.0\.2\.1 can't be bound"):
        await proxy.start()
    await proxy.stop()


async def test_a_range_beyond_the_open_files_is_told(monkeypatch):
    monkeypatch.setattr("resource.getrlimit", lambda _: (70, 70))
    proxy = Proxy(settings_for(**GOOD))
    with pytest.raises(SettingError, match=r"--port-range: .* open files"):
        await proxy.start()
    await proxy.stop()


def test_python_m_runs_the_same_command():
    ended = subprocess.run(
        [sys.executable, "-m", "rosproxy", "--version"], capture_output=True, text=True, check=True
    )
    assert ended.stdout.startswith("rosproxy")


async def test_the_proxy_starts_without_a_master_and_works_once_the_master_is_up(
    start_process, master, node
):
    await master.stop()
    process: Process = start_process()
    await until(lambda: "The proxy waits for the master" in process.text, "the proxy waits")
    assert process.text.count("The proxy waits for the master") == 1
    with pytest.raises(ConnectionResetError):
        await node.publish(process.master)
    await master.start()
    await until(lambda: "answers" in process.text, "the proxy finds the master")
    assert (await node.publish(process.master))[0] == 1


async def test_the_log_can_be_json(start_process):
    process: Process = start_process(log_format="json", log_level="debug")
    await until(lambda: "answers" in process.text, "the proxy finds the master")
    lines = [json.loads(line) for line in list(process.log)]
    assert all(line.keys() >= {"time", "level", "message"} for line in lines)


def admin_of(process: Process) -> Address:
    return host_and_port(f"http://{process.options['admin_bind']}")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_a_signal_ends_the_proxy_with_open_connections(
    start_process, master, make_node, number
):
    """At once, without waiting for pending calls: here long time-outs never end."""
    forever = (
        "import asyncio, sys; real = asyncio.timeout\n"
        "asyncio.timeout = lambda seconds: real(seconds if seconds < 15 else None)\n"
        "from rosproxy.cli.main import main; sys.argv = ['rosproxy', *sys.argv[4:]]; main()"
    )
    process: Process = start_process(prefix=[sys.executable, "-c", forever])
    node = await make_node()
    hung = await make_node("/hung", "127.0.2.12")
    await node.publish(process.master)
    await hung.publish(process.master)
    lease = host_and_port(master.holds("publishers", "/chatter")[0])
    stuck = host_and_port(master.nodes["/hung"])
    hung.hang = True
    master.answers["getParam"] = End.HANG
    get = b"GET /healthz HTTP/1.1\r\nHost: h\r\n\r\n"
    async with AsyncExitStack() as stack:
        wires = [
            await stack.enter_async_context(connect(address))
            for address in (process.master, process.master, lease, lease, stuck, lease)
        ]
        kept, waiting, idle, relay, hanging, _silent = wires
        for wire in (kept, idle):
            await wire.send(post(xml("getPid", "/n")))
            await wire.reply()
        await waiting.send(post(xml("getParam", "/n", "/p")))
        await hanging.send(post(xml("getPid", "/n")))
        await relay.send(topic_header())
        await read_header(relay)
        admin = await stack.enter_async_context(connect(admin_of(process), "127.0.0.1"))
        await admin.send(get)
        await admin.reply()
        code = await asyncio.to_thread(process.terminate, number)
        for wire in wires:
            with suppress(ConnectionResetError):
                await wire.reader.read()
    assert code == 0
    assert "ERROR" not in process.text


async def test_it_works_and_ends_although_a_name_server_hangs(start_process, make_node):
    slow = (
        "import socket, sys, time; real = socket.getaddrinfo\n"
        "def hang(host, *a, **k):\n"
        "    if host.endswith('.invalid'): time.sleep(300)\n"
        "    return real(host, *a, **k)\n"
        "socket.getaddrinfo = hang\n"
        "from rosproxy.cli.main import main; sys.argv = ['rosproxy', *sys.argv[4:]]; main()"
    )
    process: Process = start_process(prefix=[sys.executable, "-c", slow])
    node = await make_node(host="nowhere.invalid")
    assert (await node.publish(process.master))[0] == 1
    assert (await rpc(process.master, "getPid", "/n", source=NODE))[0] == 1
    assert await asyncio.to_thread(process.terminate) == 0


async def test_it_can_be_started_again_at_once_on_the_same_ports(start_process, node):
    process: Process = start_process()
    async with connect(process.master) as wire:
        await wire.send(post(xml("getPid", "/n")))
        await wire.reply()
        assert await asyncio.to_thread(process.terminate) == 0
        process.start()
    assert (await node.publish(process.master))[0] == 1


async def test_the_admin_endpoint_tells_whether_the_master_answers(make_proxy, master):
    proxy = await make_proxy()
    admin = proxy.settings.admin.host, proxy.settings.admin.port

    async def status(path: str) -> int:
        request = f"GET {path} HTTP/1.1\r\nHost: h\r\n\r\n".encode()
        return (await exchange(admin, request, "127.0.0.1")).status

    async def ready() -> bool:
        return await status("/readyz") == 200

    async def unready() -> bool:
        return await status("/readyz") == 503

    await until(ready, "the master answers")
    await master.stop()
    await until(unready, "the master is missed")
    assert await status("/healthz") == 200


async def test_the_advertised_host_may_be_a_name(make_proxy, master, node):
    proxy = await make_proxy(advertise_host="localhost")
    await node.publish(proxy.master)
    (uri,) = master.holds("publishers", "/chatter")
    assert uri.startswith("http://localhost:")
    asked = await rpc(
        (HOST, proxy.endpoint(node).port),
        "requestTopic",
        "/o",
        "/chatter",
        [["TCPROS"]],
        source=MASTER,
        host=f"localhost:{proxy.endpoint(node).port}",
    )
    assert asked[2] == ["TCPROS", "localhost", proxy.endpoint(node).port]


async def test_inside_networks_decide_who_reaches_whom_directly(make_proxy, make_node):
    proxy = await make_proxy(inside_network=("127.0.2.11/32",))
    node = await make_node()
    other = await make_node("/other", "127.0.2.12")
    await node.publish(proxy.master)
    assert (await node.subscribe(proxy.master))[2] == [node.uri]
    seen = (await other.subscribe(proxy.master))[2]
    assert seen == [proxy.uri(node).replace(HOST, proxy.master[0])]
