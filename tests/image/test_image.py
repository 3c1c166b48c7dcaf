"""The proxy's image alone: user, rights, health, size."""

import re

import pytest

from tests.docker.engine import docker, inspect, logs, wait_until

HARDENED = ("--read-only", "--cap-drop", "ALL", "--security-opt", "no-new-privileges")
# No master listens there. A proxy without a master is healthy and waits.
SETTINGS = ("--env", "ROS_MASTER_URI=http://127.0.0.1:9", "--env", "ROSPROXY_ADVERTISE_HOST=host")


def start(image: str, name: str, *options: str) -> None:
    docker("run", "--detach", "--name", name, *HARDENED, *SETTINGS, *options, image)


def health(name: str) -> str:
    state = inspect(name)["State"]
    assert state["Running"], logs(name)
    return str(state["Health"]["Status"])


def test_names_a_user_by_number(proxy_image: str) -> None:
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", inspect(proxy_image)["Config"]["User"])


def test_becomes_healthy_without_any_privilege(proxy_image: str, container_name: str) -> None:
    start(proxy_image, container_name)

    wait_until(lambda: health(container_name) == "healthy", 30, lambda: logs(container_name))

    lines = docker("exec", container_name, "cat", "/proc/1/status").splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    assert status["Uid"].split() == ["10001"] * 4
    assert int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0
    assert status["NoNewPrivs"] == "1"


def test_any_user_may_run_it(proxy_image: str, container_name: str) -> None:
    """As on OpenShift: a user without an entry in passwd, in the group 0."""
    start(proxy_image, container_name, "--user", "1000680000:0")
    wait_until(lambda: health(container_name) == "healthy", 30, lambda: logs(container_name))


RULES = "add table inet test; add chain inet test c { type nat hook prerouting priority 0; }"
KERNEL = {
    "NET_ADMIN": (("--cap-add", "NET_ADMIN"), True),
    "nothing": ((), False),
    "no-new-privileges": (
        ("--cap-add", "NET_ADMIN", "--security-opt", "no-new-privileges:true"), False),
    "another user": (("--cap-add", "NET_ADMIN", "--user", "10002:10002"), False),
}  # fmt: skip


@pytest.mark.parametrize("given", KERNEL)
def test_its_user_makes_rules_where_it_may(proxy_image: str, given: str) -> None:
    options, may = KERNEL[given]
    hardened = ("run", "--rm", "--read-only", "--cap-drop", "ALL", *options, "--entrypoint")
    nft = (*hardened, "/usr/libexec/rosproxy/nft", proxy_image, RULES)
    conntrack = (*hardened, "/usr/libexec/rosproxy/conntrack", proxy_image, "-L", "-p", "tcp")

    for command in (nft, conntrack):
        said = docker(*command, check=may)
        refused = re.search("(?i)not permitted|permission denied|get CAP_NET_ADMIN", said)
        assert bool(refused) != may, said


def test_writes_no_file(proxy_image: str, container_name: str) -> None:
    start(proxy_image, container_name)
    wait_until(lambda: health(container_name) == "healthy", 30, lambda: logs(container_name))
    mounts = docker("exec", container_name, "cat", "/proc/1/mounts").splitlines()
    root = next(line.split() for line in mounts if line.split()[1] == "/")
    assert "ro" in root[3].split(",")
    assert docker("diff", container_name) == ""


def test_stops_at_once_and_cleanly(proxy_image: str, container_name: str) -> None:
    start(proxy_image, container_name)
    wait_until(lambda: "listening: " in logs(container_name), 60, "the proxy is ready")

    docker("stop", "--time", "50", container_name)  # after 50 s: killed, code 137

    assert inspect(container_name)["State"]["ExitCode"] == 0, logs(container_name)


def test_names_a_bad_setting_and_exits(proxy_image: str, container_name: str) -> None:
    start(proxy_image, container_name, "--env", "ROSPROXY_PORT_RANGE=9-1")

    assert docker("wait", container_name) == "2"

    logged = logs(container_name)
    assert "port-range" in logged
    assert len(logged.splitlines()) == 1


@pytest.mark.parametrize(("image", "most"), [("proxy_image", 45), ("controller_image", 135)])
def test_adds_little_to_its_base(image: str, most: int, request: pytest.FixtureRequest) -> None:
    """The size that the build adds to a base with Python, in MiB."""
    measure = ("--entrypoint", "du", request.getfixturevalue(image), "-sm", "/opt/rosproxy")
    assert int(docker("run", "--rm", *measure).split()[0]) <= most


def test_ships_no_installer(proxy_image: str) -> None:
    listing = ("--entrypoint", "ls", proxy_image, "/opt/rosproxy/bin")
    assert "pip" not in docker("run", "--rm", *listing).split()


@pytest.mark.parametrize("image", ["proxy_image", "controller_image"])
def test_no_program_changes_its_user_or_group(image: str, request: pytest.FixtureRequest) -> None:
    search = ("--user", "0:0", "--entrypoint", "find", request.getfixturevalue(image), "/")
    listing = docker("run", "--rm", *search, "-xdev", "-perm", "/6000", "-type", "f")
    assert listing.split() == []
