"""The operator's own containers, and the detection of forged containers."""

from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs

from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.engine_json import check_inspection, read_making
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.own_containers import forgery_reason, has_own_name
from rosproxy_operator.docker.planner.specs import (
    container_config,
    own_labels,
    proxy_name,
    read_own,
    sandbox_config,
    sandbox_name,
)
from rosproxy_operator.proxy_spec.spec import ProxySpec
from tests.unit.operator.docker.builders import IMAGE, PLACE, SECRET, SETTINGS, inspection

PORTS = PortRange(11400, 11401)
BOX = CreateSandbox(sandbox_name(PLACE), PLACE, PORTS)
PROCESS = Create(proxy_name(PLACE), PLACE, PORTS, "id-of-the-sandbox")
MADE = {
    "sandbox": inspection(sandbox_config(BOX, SETTINGS)),
    "proxy": inspection(container_config(PROCESS, SETTINGS, SECRET, "")),
}
NAMES = {"sandbox": BOX.name, "proxy": PROCESS.name}


def wrong(inspected: dict[str, Any], name: str, image: str = IMAGE) -> str:
    """The operator's reason why a container is forged, or empty."""
    own = read_own(inspected["Config"]["Labels"])
    assert own is not None
    return forgery_reason(own, name, read_making(check_inspection(inspected)), image)


def changed(role: str, *path: str, value: object) -> dict[str, Any]:
    """The inspection of an own container with a single changed value."""
    inspected = {key: dict(inner) if isinstance(inner, dict) else inner
                 for key, inner in MADE[role].items()}  # fmt: skip
    at = inspected
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return inspected


@pytest.mark.parametrize("role", MADE)
@pytest.mark.parametrize("behind", ["", "-2", "-old", "-old-2", "-2-old", "-12-old-3"])
def test_what_the_operator_makes_is_its_own(role: str, behind: str) -> None:
    assert wrong(MADE[role], NAMES[role] + behind) == ""


@pytest.mark.parametrize("capability", ["NET_ADMIN", "CAP_NET_ADMIN"])
def test_so_are_those_for_the_kernel_plane(capability: str) -> None:
    box = sandbox_config(structs.replace(BOX, spec=ProxySpec(data_plane="kernel")), SETTINGS)
    body = container_config(
        structs.replace(PROCESS, spec=ProxySpec(data_plane="kernel")), SETTINGS, SECRET, ""
    )
    process = inspection(body)
    process["HostConfig"]["CapAdd"] = [capability]
    assert wrong(inspection(box), BOX.name) == wrong(process, PROCESS.name) == ""


def test_so_is_one_with_ports_for_udp() -> None:
    box = inspection(sandbox_config(structs.replace(BOX, spec=ProxySpec(udp=True)), SETTINGS))
    assert wrong(box, BOX.name) == ""
    del box["HostConfig"]["PortBindings"]["11400/udp"]
    assert "PortBindings" in wrong(box, BOX.name)


def test_what_options_decide_makes_no_stranger() -> None:
    """The planner recreates containers of an operator with other options."""
    other = replace(SETTINGS, uplink="0-other", publish_address=("::", "0.0.0.0"), proxy_memory=0,
                    proxy_pids=0, slave_control="master", secret="other")  # fmt: skip
    assert wrong(inspection(sandbox_config(BOX, other)), BOX.name) == ""
    body = container_config(PROCESS, other, "other", "192.0.2.7")
    assert wrong(inspection(body), PROCESS.name) == ""


@pytest.mark.parametrize("role", MADE)
def test_nor_does_what_docker_update_may_change(role: str) -> None:
    for name, value in (("Memory", 5), ("PidsLimit", 1), ("RestartPolicy", {"Name": "no"})):
        assert wrong(changed(role, "HostConfig", name, value=value), NAMES[role]) == ""


def test_the_process_of_a_former_image_is_known_by_user_and_command() -> None:
    assert wrong(MADE["proxy"], PROCESS.name, "another image") == ""
    wrapped = changed("proxy", "Config", "Cmd", value=["python3", "evil.py"])
    assert wrong(wrapped, PROCESS.name) == ""  # the present image's own
    told = "the command is not rosproxy run"
    assert wrong(wrapped, PROCESS.name, "another image") == told
    assert wrong(changed("proxy", "Config", "User", value=""), PROCESS.name).startswith("the user")


@pytest.mark.parametrize("role", MADE)
def test_an_image_can_have_labels_command_user_and_variables_and_no_more(role: str) -> None:
    """``docker run --name …`` of an image with every forged value that an image can have."""
    forged = {**MADE[role], "HostConfig": {"NetworkMode": "app", "IpcMode": "private"}}
    assert wrong(forged, "evil") == f"the name is not {NAMES[role]}"
    assert wrong(forged, NAMES[role]).startswith("HostConfig.ReadonlyRootfs")


FORGED: list[tuple[str, str, list[Any]]] = [
    ("both", "ReadonlyRootfs", [False, None]),
    ("both", "CapDrop", [None, [], ["NET_RAW"]]),
    ("both", "CapAdd", [["SYS_ADMIN"], ["NET_ADMIN"], ["NET_ADMIN", "SYS_ADMIN"]]),
    ("both", "SecurityOpt", [None, [], ["no-new-privileges:false"], ["seccomp=unconfined"]]),
    ("both", "Privileged", [True]),
    ("both", "Binds", [["/:/host"]]),
    ("both", "Mounts", [[{"Type": "bind", "Source": "/"}]]),
    ("both", "VolumesFrom", [["other"]]),
    ("both", "Devices", [[{"PathOnHost": "/dev/kmsg"}]]),
    ("both", "GroupAdd", [["0"]]),
    ("both", "PidMode", ["host", "container:x"]),
    ("both", "UTSMode", ["host"]),
    ("both", "IpcMode", ["host", "container:x"]),
    ("sandbox", "NetworkMode", ["host", "none", "container:x"]),
    ("sandbox", "PortBindings", [
        None, {}, {"11400/tcp": [{"HostPort": "11400"}]},
        {"11400/tcp": [{"HostPort": "11400"}], "11401/tcp": [{"HostPort": "80"}]},
        {"11400/tcp": [{"HostPort": "11400"}], "11401/tcp": None},
    ]),
    ("sandbox", "Sysctls", [None, {"net.ipv4.ip_forward": "1"}]),
    ("proxy", "NetworkMode", ["host", "0-rosproxy", "", None]),
    ("proxy", "PortBindings", [{"1/tcp": [{"HostPort": "1"}]}]),
]  # fmt: skip


@pytest.mark.parametrize(
    ("role", "name", "value"),
    [
        (forged_role, name, value)
        for role, name, values in FORGED
        for value in values
        for forged_role in ([role] if role != "both" else MADE)
    ],
)
def test_whoever_makes_one_by_hand_gives_himself_away(role: str, name: str, value: object) -> None:
    forged = changed(role, "HostConfig", name, value=value)
    assert wrong(forged, NAMES[role]).startswith(f"HostConfig.{name} ")


@pytest.mark.parametrize(
    "name", ["evil", f"{BOX.name}-evil", f"x{BOX.name}", PROCESS.name, f"{BOX.name}\n", ""]
)
def test_other_names(name: str) -> None:
    own = read_own(own_labels(BOX))
    assert own is not None
    assert not has_own_name(own, name)
