"""The command line of the operator: each mistake gives a line that names the option."""

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyMode
from rosproxy_operator.cli import main
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker import host_status
from rosproxy_operator.docker.host_status import HostStatus
from rosproxy_operator.docker.option_values import read_memory
from rosproxy_operator.docker.settings import DEFAULT_ADMIN, PlanSettings, make_plan_settings


def run(*words: str, **variables: str) -> Result:
    return CliRunner().invoke(main, words, env={"DOCKER_HOST": "unix:///nowhere", **variables})


def test_the_defaults() -> None:
    options = main.commands["docker"].make_context("docker", []).params
    assert make_plan_settings(options) == PlanSettings()
    assert options["admin_bind"] == DEFAULT_ADMIN
    assert options["resync"] == 30.0
    assert PlanSettings().publish_address == ("0.0.0.0",)
    assert PlanSettings().uplink == "0-rosproxy"


@pytest.mark.parametrize(
    ("option", "value", "told"),
    [
        ("--ports", "0", "0 is not in the range 1<=x<=1000; for example 32"),
        ("--ports", "1001", "1001 is not in the range 1<=x<=1000; for example 32"),
        ("--port-window", "5-1", "'5-1' must rise"),
        ("--port-window", "11400-11410", "11400-11410 has 11 ports, fewer than --ports 32"),
        ("--publish-address", "here", "'here' is not an IP address"),
        ("--master-uri", "robot", "'robot' is not of the form http://host:11311"),
        (
            "--master-uri",
            "http://localhost:11311",
            "is a loopback address: for a container, that is",
        ),
        ("--advertise-host", "a b", "'a b' is neither a host name nor an address"),
        ("--proxy-image", "", "'' is not the name of an image"),
        ("--uplink", "-x", "'-x' can't be the name of a Docker network"),
        ("--admin-bind", "11313", "'11313' is not of the form 127.0.0.1:11313"),
        ("--admin-bind", "none", "'none' is not of the form 127.0.0.1:11313"),
        ("--allow-master", "a b", "'a b' is not of the form HOST or HOST:PORT"),
        ("--allow-peer", "a/b", "'a/b' is not of the form HOST or HOST:PORT"),
        ("--allow-link", "a/b", "'a/b' is not of the form tls/HOST or tls/HOST:PORT"),
        ("--max-ports", "1001", "1001 is not in the range 1<=x<=1000; for example 100"),
        ("--allow-data-plane", "fast", "'fast' is not one of"),
        ("--slave-control", "none", "'none' is not one of"),
        ("--proxy-memory", "much", "'much' is neither a size from 64m to 1024g, such as 1g"),
        ("--proxy-memory", "8m", "'8m' is neither a size from 64m to 1024g"),
        ("--proxy-pids", "9", "'9' is neither a number from 256 on"),
        ("--proxy-pids", "-1", "'-1' is neither a number from 256 on"),
        ("--secret-file", "/nowhere", "/nowhere can't be read: No such file or directory"),
        ("--policy", "hide /camera", "rule 'hide /camera': must be ACTION KIND GLOB"),
        ("--policy-mode", "tell", "'tell' is not one of"),
        ("--grace", "-1", "-1 s is not between 0 and 86400 s"),
        ("--resync", "0", "0 s is not between 1 and 86400 s"),
    ],
)
def test_a_bad_value_names_its_option(option: str, value: str, told: str) -> None:
    result = run("docker", f"{option}={value}")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"rosproxy-operator: {option}: ")
    assert told in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "size"),
    [("0", 0), ("64m", 64 * 1024**2), ("1G", 1024**3), ("2gb", 2 * 1024**3), ("134217728", 2**27)],
)
def test_sizes(text: str, size: int) -> None:
    assert read_memory(text) == size


def test_lists_in_variables_and_a_secret_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "secret"
    file.write_text(f" {'s' * 32}\n")
    for name, value in (
        ("ALLOW_MASTER", "robot arm*:11311"),
        ("ALLOW_PEER", "robot *:11400"),
        ("ALLOW_DATA_PLANE", "kernel copy"),
        ("PROXY_MEMORY", "512m"),
        ("SECRET_FILE", str(file)),
    ):
        monkeypatch.setenv(f"ROSPROXY_{name}", value)
    options = (
        main.commands["docker"].make_context("docker", [], auto_envvar_prefix="ROSPROXY").params
    )
    settings = make_plan_settings(options)
    assert settings.allow_master == ("robot:*", "arm*:11311")
    assert settings.allow_peer == ("robot:*", "*:11400")
    assert settings.allow_data_plane == ("kernel", "copy")
    assert (settings.proxy_memory, settings.secret) == (512 * 1024**2, "s" * 32)
    file.write_text("short")
    result = run("docker", "plan", ROSPROXY_SECRET_FILE=str(file))
    assert "has fewer than 32 characters. openssl rand -hex 32" in result.stderr


def test_every_option_has_a_variable() -> None:
    result = run("docker", "plan", ROSPROXY_PORTS="0")
    assert (
        result.stderr
        == "rosproxy-operator: --ports: 0 is not in the range 1<=x<=1000; for example 32\n"
    )
    result = run("docker", "plan", ROS_MASTER_URI="robot")
    assert result.stderr.startswith("rosproxy-operator: --master-uri: 'robot'")


@pytest.mark.parametrize("words", [["docker", "--nope"], ["nope"], ["docker", "status", "x"]])
def test_a_wrong_word_is_one_line(words: list[str]) -> None:
    result = run(*words)
    assert result.exit_code == 2
    assert result.stderr.startswith("rosproxy-operator: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("words", [["status"], ["plan"], ["--once"], ["uninstall"]])
def test_no_engine_is_one_line_that_says_what_to_do(words: list[str]) -> None:
    result = run("docker", *words)
    assert result.exit_code == 1
    assert (
        "the socket /nowhere of the Docker engine does not exist. Start the engine" in result.stderr
    )
    assert "Traceback" not in result.stderr


def test_a_misspelt_variable_is_told_with_the_one_that_was_meant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Commands print the problem at once. The operator keeps reporting the problem."""
    misspelt = "is not a variable of rosproxy and is ignored; did you mean ROSPROXY_PORT_WINDOW?"
    result = run("docker", "status", ROSPROXY_PORT_WINDO="12000-12999")
    assert f"ROSPROXY_PORT_WINDO {misspelt}" in result.stderr
    told: list[Problem] = []
    monkeypatch.setattr(
        "rosproxy_operator.docker.controller.run", lambda *given: told.extend(given[-1])
    )
    run("docker", ROSPROXY_PORT_WINDO="12000-12999", ROSPROXY_PORT_RANGE="11000-11009")
    (problem,) = told
    assert (problem.subject, problem.text) == ("variable ROSPROXY_PORT_WINDO", misspelt)
    assert (problem.fatal, problem.reason) == (False, "UnknownName")


def test_uninstall_says_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    problems = [Problem("network 0-rosproxy", "stays", reason="X")]
    monkeypatch.setattr("rosproxy_operator.docker.host_status.ask_operators", lambda _: None)
    monkeypatch.setattr("rosproxy_operator.docker.controller.uninstall", lambda *_: problems)
    result = run("docker", "uninstall")
    assert result.exit_code == 1
    assert result.stderr == "rosproxy-operator: network 0-rosproxy: stays\n"
    problems.clear()
    assert run("docker", "uninstall").exit_code == 0


def test_uninstall_refuses_beside_an_operator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with options. With options, `status` and `plan` do not ask the running operator."""
    answer = {"operator": "http://127.0.0.1:11313", "version": "another"}
    monkeypatch.setattr("rosproxy_operator.docker.host_status.ask_operators", lambda _: answer)
    result = run("docker", "--proxy-image", "other", "uninstall")
    assert result.exit_code == 1
    assert "an operator is running at http://127.0.0.1:11313" in result.stderr
    assert "docker rm -f rosproxy-operator" in result.stderr


@pytest.mark.parametrize("has_browser", [True, False])
def test_status_opens_the_page_of_the_operator(
    monkeypatch: pytest.MonkeyPatch, has_browser: bool
) -> None:
    opened: list[str] = []
    answer = {"operator": "http://127.0.0.1:11313", "version": "another"}
    monkeypatch.setattr("rosproxy_operator.docker.host_status.ask_operators", lambda _: answer)

    def browse(url: str) -> bool:
        opened.append(url)
        return has_browser

    monkeypatch.setattr("webbrowser.open", browse)
    result = run("docker", "status", "--open")
    assert (result.exit_code, result.stdout) == (0, "http://127.0.0.1:11313/\n")
    assert opened == ["http://127.0.0.1:11313/"]
    assert ("ssh -L 11313:127.0.0.1:11313 HOST" in result.stderr) is not has_browser


def test_without_an_operator_there_is_no_page_to_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rosproxy_operator.docker.host_status.ask_operators", lambda _: None)
    result = run("docker", "status", "--open")
    assert result.exit_code == 1
    assert (
        "no operator answers at http://127.0.0.1:11313, so there is no live page" in result.stderr
    )
    assert run("docker", "status", "--open", "--json").exit_code == 2


def test_once_is_for_the_controller_itself() -> None:
    result = run("docker", "--once", "status")
    assert result.exit_code == 2
    assert "--once and status exclude each other" in result.stderr


def test_a_problem_with_an_odd_name_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    problems = [Problem("container a\nforged", "\x1b[2J is no port", reason="X")]
    monkeypatch.setattr("rosproxy_operator.docker.controller.run_once", lambda *_: problems)
    result = run("docker", "--once")
    assert result.exit_code == 1
    assert result.stderr == "rosproxy-operator: container a\\nforged: \\x1b[2J is no port\n"


def test_health_of_a_controller_that_is_not_there() -> None:
    result = run("health", ROSPROXY_ADMIN_BIND="127.0.0.1:1")
    assert result.exit_code == 1
    assert result.stderr == "rosproxy-operator: no operator answers at http://127.0.0.1:1\n"


def test_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    done = CliRunner().invoke(main, ["docker", "--once"])
    assert done.exit_code == 1
    assert "pip install 'rosproxy[docker]'" in done.stderr
    assert "Traceback" not in done.output


def test_a_policy_can_stand_in_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unlike in other variables, blanks separate no values."""
    monkeypatch.setenv("ROSPROXY_POLICY", "deny publish /camera/*;\ndeny serve * by /driver")
    monkeypatch.setenv("ROSPROXY_POLICY_MODE", "audit")
    words = ["--policy=deny call *"]
    for given, rules in (
        ([], ["deny publish /camera/*", "deny serve * by /driver"]),
        (words, ["deny call *"]),
    ):
        context = main.commands["docker"].make_context(
            "docker", given, auto_envvar_prefix="ROSPROXY"
        )
        (layer,) = make_plan_settings(context.params).policy
        assert [str(rule) for rule in layer.rules] == rules
        assert layer.mode is PolicyMode.AUDIT


@pytest.mark.parametrize(
    ("words", "variables", "operator"),
    [
        ([], {}, DEFAULT_ADMIN),
        ([], {"ROSPROXY_PORTS": "8"}, DEFAULT_ADMIN),
        (["--admin-bind", "127.0.0.1:11400"], {}, HostPort("127.0.0.1", 11400)),
        ([], {"ROSPROXY_ADMIN_BIND": "0.0.0.0:11400"}, HostPort("0.0.0.0", 11400)),
        (["--ports", "8"], {}, None),
        (["--admin-bind", "127.0.0.1:11400", "--ports", "8"], {}, None),
    ],
)
def test_the_running_operator_is_asked_unless_options_are_given(
    words: list[str],
    variables: dict[str, str],
    operator: HostPort | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[HostPort | None] = []

    def show_status(host: HostStatus, as_json: bool, wait: float) -> int:
        asked.append(host.operator)
        return 0

    monkeypatch.setattr(host_status, "show_status", show_status)
    assert run("docker", *words, "status", **variables).exit_code == 0
    assert asked == [operator]
