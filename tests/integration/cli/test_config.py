"""The file of ``--config``, unknown variables, help, colours and completion."""

import fcntl
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import termios
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
import pytest

from examples.demo.proxy_process import clean_environment
from rosproxy.cli.variables import unknown
from tests.integration.commands import admin_url, run
from tests.integration.process import Process
from tests.integration.proxy import Proxy

GOOD = ("--master-uri", "http://robot:11311", "--advertise-host", "host")
PROGRAMS = Path(sys.executable).parent


async def check(*words: str, **environment: Any) -> tuple[int, str]:
    """The exit code and the last words of ``rosproxy run --check``."""
    ended = await run("run", "--check", *words, **environment)
    assert "Traceback" not in ended.err
    return ended.code, ended.err


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "rosproxy.toml"
    made.write_text(
        'master-uri = "http://robot:11311"\nadvertise-host = "host"\nport-range = "11400-11409"\n'
        'policy = ["deny publish /camera/*", "deny call /reset"]\nprobe-interval = 2\nudp = true\n'
        'direction = "both"\ninside-network = ["172.18.0.0/16"]\n'
    )
    return made


async def test_a_file_has_what_neither_the_command_line_nor_a_variable_gives(file: Path):
    """The message shows which source of the range wins: the master's port lies in this range."""
    port = ("--master-port", "11405")
    code, text = await check("--config", str(file), *port)
    assert (code, "lies in --port-range 11400-11409" in text) == (2, True)
    code, text = await check(*port, ROSPROXY_CONFIG=str(file), ROSPROXY_PORT_RANGE="11405-11420")
    assert (code, "lies in --port-range 11405-11420" in text) == (2, True)
    words = ("--config", str(file), "--port-range", "11401-11420", *port)
    code, text = await check(*words, ROSPROXY_PORT_RANGE="11405-11420")
    assert (code, "lies in --port-range 11401-11420" in text) == (2, True)
    assert await check("--config", str(file)) == (0, "")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('port-rang = "1-2"', "unknown key 'port-rang'; did you mean port-range?"),
        ("check = true", "unknown key 'check'"),
        ('xyzzy = "1"', "keys are the names of options, without --"),
        ("port-range = 5", "--port-range"),
        ('port-range = ["1-2"]', "port-range takes one value, not a list"),
        ("port-range = 1979-05-27", "port-range must be a text in quotes, or a number"),
        ("[port-range]\na = 1", "port-range must be a text in quotes, or a number"),
        ('udp = "yes"', "udp must be true or false"),
        ("master-port = 70000", "--master-port"),
        ("port-range = 11000-11099", "is not TOML"),
        ("a = " + "[" * 100_000, "is not TOML"),
        ("\x00", "is not TOML"),
        ("#" * 1_100_000, "is longer than"),
    ],
)
async def test_a_mistake_in_the_file_is_told_in_one_line(tmp_path: Path, text: str, told: str):
    file = tmp_path / "bad.toml"
    file.write_text(text + "\n")
    code, said = await check(*GOOD, "--config", str(file))
    assert (code, said.count("\n")) == (2, 1), said
    assert told in said


async def test_a_file_that_is_not_there(tmp_path: Path):
    code, said = await check(*GOOD, "--config", str(tmp_path / "none.toml"))
    assert (code, "none.toml can't be read: No such file or directory" in said) == (2, True)
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    code, said = await check(*GOOD, "--config", str(tmp_path / "bytes.toml"))
    assert (code, "is not UTF-8 text" in said) == (2, True)


async def test_status_asks_where_the_file_says(proxy: Proxy, tmp_path: Path):
    file = tmp_path / "rosproxy.toml"
    file.write_text(f'admin-bind = "{proxy.settings.admin}"\n')
    ended = await run("status", ROSPROXY_CONFIG=str(file))
    assert (ended.code, ended.err) == (0, "")


@pytest.mark.parametrize("program", ["rosproxy-operator docker", "rosproxy-operator kubernetes"])
def test_the_operators_take_a_file(tmp_path: Path, program: str):
    file = tmp_path / "operator.toml"
    file.write_text('max-port = "5"\n')
    name, command = program.split()
    ended = subprocess.run(
        [PROGRAMS / name, command, "--config", file, "doctor"],
        capture_output=True,
        text=True,
        check=False,
        env=clean_environment(),
    )
    assert ended.returncode == 2
    assert "unknown key 'max-port'; did you mean max-ports?" in ended.stderr


@pytest.mark.parametrize("engine", ["docker", "kubernetes"])
def test_the_operators_use_what_the_file_says(tmp_path: Path, engine: str):
    from rosproxy_operator.cli import main

    file = tmp_path / "operator.toml"
    file.write_text('max-ports = "7"\nproxy-image = "rosproxy:1"\n')
    words = ["--config", str(file), "--proxy-image=rosproxy:2", "doctor"]
    params = main.commands[engine].make_context(engine, words).params
    assert (params["max_ports"], params["proxy_image"]) == (7, "rosproxy:2")


async def test_a_misspelt_variable_is_told_with_the_one_that_was_meant(start_process, monkeypatch):
    code, said = await check(*GOOD, ROSPROXY_PORT_RANG="11000-11005")
    assert code == 0
    assert "ROSPROXY_PORT_RANG is not a variable of rosproxy and is ignored" in said
    assert "did you mean ROSPROXY_PORT_RANGE?" in said
    clean = clean_environment(ROSPROXY_PORT_RANG="11000-11005")
    monkeypatch.setattr("tests.integration.process.clean_environment", lambda: clean)
    process: Process = start_process()
    assert "ROSPROXY_PORT_RANGE?" in process.text
    shown = await run("status", "--admin", f"http://{process.options['admin_bind']}")
    assert "ROSPROXY_PORT_RANG: is not a variable" in shown.out
    told = await run("doctor", ROSPROXY_PORT_RANG="1", ROSPROXY_ADMIN=process.options["admin_bind"])
    assert "unset ROSPROXY_PORT_RANG, and set the variable that was meant" in told.out


KNOWN = ("ROSPROXY_PORT_RANGE", "ROSPROXY_ADMIN", "ROS_MASTER_URI", "ROS_DOMAIN_ID")


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("ROSPROXY_PORT_RANG", "ROSPROXY_PORT_RANGE"),
        ("ROSPROXY_PORTS", "ROSPROXY_PORT_RANGE"),
        ("rosproxy_port_range", "ROSPROXY_PORT_RANGE"),
        ("ROS_PROXY_PORT_RANGE", "ROSPROXY_PORT_RANGE"),
        ("ROS_MASTER_URL", "ROS_MASTER_URI"),
        ("ROSPROXY_XYZZY", ""),
    ],
)
def test_a_variable_that_looks_like_ours(name: str, meant: str):
    (variable,) = unknown({name: "1", "ROSPROXY_PORT_RANGE": "1-2"}, KNOWN)
    assert (variable.name, variable.suggestion) == (name, meant)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ROSPROXY_SERVICE_HOST", "10.0.0.1"),
        ("ROSPROXY_OPERATOR_SERVICE_PORT_HTTPS", "443"),
        ("ROSPROXY_PORT", "tcp://10.0.0.1:11311"),
        ("ROSPROXY_PORT_11311_TCP_ADDR", "10.0.0.1"),
        ("ROS_IP", "10.0.0.1"),
        ("ROS_DISTRO", "noetic"),
        ("ROS_PACKAGE_PATH", "/opt"),
        ("PORT_RANGE", "1"),
    ],
)
def test_a_variable_that_is_anothers(name: str, value: str):
    assert unknown({name: value}, KNOWN) == []


@pytest.mark.parametrize("words", [("run",), ("lan-relay",), ("doctor",)])
async def test_help_names_the_variable_of_each_option(words: tuple[str, ...]):
    from rosproxy.cli.main import main
    from rosproxy.cli.options import variables_of

    text = " ".join((await run(*words, "--help")).out.split())
    command = main.commands[words[0]]
    prefix = command.context_settings.get("auto_envvar_prefix")
    for option in command.params:
        if isinstance(option, click.Option):
            assert all(variable in text for variable in variables_of(option, prefix))
    assert ("ROSPROXY_PORT_RANGE" in text) == (words[0] == "run")
    assert "ROSPROXY_CHECK" not in text


@pytest.mark.parametrize("engine", ["docker", "kubernetes"])
def test_help_of_the_operators_names_the_variables(engine: str):
    from rosproxy.cli.options import variables_of
    from rosproxy_operator.cli import main

    words = (PROGRAMS / "rosproxy-operator", engine, "--help")
    text = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    options = [p for p in main.commands[engine].params if isinstance(p, click.Option)]
    assert len(options) > 10
    for option in options:
        for variable in variables_of(option, "ROSPROXY"):
            assert re.search(rf"\b{variable}\b", text), variable


async def test_status_waits_until_the_proxy_is_ready(start_process, master):
    await master.stop()
    process: Process = start_process()
    admin = f"http://{process.options['admin_bind']}"
    early = await run("status", "--admin", admin)
    assert early.code == 1
    assert "DOWN" in early.out
    assert "answers HTTP 503" in early.err
    await master.start()
    late = await run("status", "--wait", "60", "--admin", admin)
    assert (late.code, late.err) == (0, "")
    none = await run("status", "--wait", "1", "--admin", "http://127.0.0.1:1")
    assert (none.code, none.err.count("\n")) == (1, 1)


def on_a_terminal(*words: str, **environment: str) -> str:
    """The output of a command in a separate terminal."""
    controller, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    clean = clean_environment(**{"TERM": "xterm-256color", **environment})
    for name in ("NO_COLOR", "FORCE_COLOR"):
        if name not in environment:
            clean.pop(name, None)
    with subprocess.Popen(
        [sys.executable, "-m", "rosproxy", *words], stdout=terminal, stderr=terminal, env=clean
    ):
        os.close(terminal)
        said = b""
        with suppress(OSError):
            while chunk := os.read(controller, 65536):
                said += chunk
    os.close(controller)
    return said.decode()


@pytest.mark.parametrize(
    ("environment", "coloured"),
    [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)],
)
def test_a_terminal_gets_colours_unless_it_wants_none(environment, coloured):
    words = ["run", "--check", "--deep", "--master-uri", "http://127.0.0.1:1"]
    words += ["--advertise-host", "127.0.0.1", "--port-range", "24800-24802"]
    words += ["--master-port", "24804", "--admin-bind", "127.0.0.1:24805"]
    text = on_a_terminal(*words, **environment)
    assert "ERROR" in text
    assert ("\x1b[1;31m" in text) == coloured, text
    assert ("\x1b[3" in text) == coloured


async def test_no_terminal_gets_no_colours(proxy: Proxy):
    text = (await run("doctor", "--admin", admin_url(proxy), FORCE_COLOR="")).out
    assert "\x1b" not in text


COMPLETE = """
eval "$(_{variable}_COMPLETE=bash_source {program})"
COMP_WORDS=({program} {words}) COMP_CWORD={index}
_{function}_completion {program}
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("rosproxy st", {"status"}),
        ("rosproxy run --data-plane k", {"kernel"}),
        ("rosproxy run --advertise-p", {"--advertise-port-range"}),
        ("rosproxy-operator do", {"docker"}),
        ("rosproxy-operator docker --publish-a", {"--publish-address"}),
        ("rosproxy-operator docker st", {"status"}),
    ],
)
def test_bash_completes(words: str, expected: set[str]):
    """As documented: eval "$(_ROSPROXY_COMPLETE=bash_source rosproxy)"."""
    bash = shutil.which("bash")
    assert bash
    program, *rest = words.split()
    script = COMPLETE.format(
        variable=program.upper().replace("-", "_"),
        function=program.replace("-", "_"),
        program=program,
        words=" ".join(rest),
        index=len(rest),
    )
    path = f"{PROGRAMS}:{os.environ['PATH']}"
    ended = subprocess.run(
        [bash, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        env=clean_environment(PATH=path),
    )
    assert set(ended.stdout.split()) == expected, ended.stderr


async def test_both_variables_of_an_option_are_read_and_known():
    for name in ("ROS_MASTER_URI", "ROSPROXY_MASTER_URI"):
        told = await check("--advertise-host", "host", **{name: "http://robot:11311"})
        assert told == (0, "")


async def test_a_variable_that_is_not_read_is_called_unknown():
    """Some options have another variable. click would also read the variable of the
    option's name.
    """
    code, said = await check(*GOOD, ROSPROXY_INSIDE_NETWORK="no network")
    assert code == 0
    assert "ROSPROXY_INSIDE_NETWORK is not a variable of rosproxy" in said
