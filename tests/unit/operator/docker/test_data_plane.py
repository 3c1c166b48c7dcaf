"""The data plane of a proxy, and the capabilities of its containers."""

from dataclasses import replace

import pytest
from msgspec import structs

from rosproxy.shared.setting_kinds import DataPlane
from rosproxy_operator.docker.planner.actions import Action, Create, CreateSandbox
from rosproxy_operator.docker.planner.model import Container, Proxy, Sandbox
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import (
    container_config,
    proxy_fingerprint,
    proxy_name,
    sandbox_config,
    sandbox_fingerprint,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.spec import ProxySpec
from tests.unit.operator.docker import builders
from tests.unit.operator.docker.builders import (
    ENABLED,
    IMAGE,
    PLACE,
    RANGE,
    SECRET,
    container,
    observed,
    planned,
    proxy,
    sandbox,
)

SETTINGS = replace(builders.SETTINGS, allow_data_plane=("auto", "kernel", "splice", "copy"))
LABEL = "rosproxy.data-plane"
NAME = proxy_name(PLACE)
SANDBOX = CreateSandbox("s", PLACE, RANGE, fingerprint="f1")
PROXY = Create("p", PLACE, RANGE, "s")


def asking(name: str, plane: str, state: str = "running") -> Container:
    return container(name, {**ENABLED, LABEL: plane}, state=state)


def look(
    *containers: Container,
    existing_pair: tuple[Sandbox, Proxy] | None = None,
    settings: PlanSettings = SETTINGS,
    memory: DockerMemory | None = None,
    now: float = 0.0,
) -> DockerPlan:
    boxes, proxies = ([existing_pair[0]], [existing_pair[1]]) if existing_pair else ([], [])
    seen = observed(*containers, sandboxes=boxes, proxies=proxies)
    return planned(seen, settings, memory or DockerMemory(), now)


def given(plan: DockerPlan) -> DataPlane:
    return plan.desired[0].spec.data_plane


def made(actions: tuple[Action, ...]) -> tuple[list[bool], list[DataPlane]]:
    """Whether each created sandbox is for the kernel plane, and the data planes of created
    proxies.
    """
    boxes = [
        action.spec.data_plane == "kernel"
        for action in actions
        if isinstance(action, CreateSandbox)
    ]
    return boxes, [action.spec.data_plane for action in actions if isinstance(action, Create)]


def own(plane: DataPlane) -> tuple[Sandbox, Proxy]:
    """A sandbox and a proxy that were created for a data plane."""
    spec = ProxySpec(data_plane=plane)
    box = sandbox_fingerprint(structs.replace(SANDBOX, spec=spec), SETTINGS)
    process = proxy_fingerprint(structs.replace(PROXY, spec=spec), SETTINGS, IMAGE, SECRET)
    return sandbox(made=box), proxy(made=process)


# what is asked for


def test_nobody_asks_for_anything() -> None:
    assert given(look(container())) == "auto"
    assert given(look(container(), settings=replace(SETTINGS, data_plane="kernel"))) == "kernel"


@pytest.mark.parametrize("plane", ["auto", "kernel", "splice", "copy", " Kernel "])
def test_a_label_goes_before_the_option(plane: str) -> None:
    for option in ("auto", "kernel", "copy"):
        plan = look(asking("a", plane), settings=replace(SETTINGS, data_plane=option))
        assert given(plan) == plane.strip().lower()
        assert plan.problems == ()


def test_a_container_whose_label_is_outvoted_gets_a_problem() -> None:
    plan = look(asking("a", "copy"), asking("b", "kernel"), container("c"), asking("d", "auto"))
    assert given(plan) == "kernel"
    assert [(p.subject, p.fatal) for p in plan.problems] == [
        ("container a", False),
        ("container d", False),
    ]
    assert plan.problems[0].message == (
        "label rosproxy.data-plane=copy is ignored: the proxy also serves container b, whose "
        "label asks for kernel. Give both containers the same value"
    )


# what is created


@pytest.mark.parametrize("plane", ["auto", "kernel", "splice", "copy"])
def test_the_first_container_of_a_host(plane: DataPlane) -> None:
    assert made(look(asking("a", plane)).actions) == ([plane == "kernel"], [plane])


def test_the_capability_is_for_the_kernel_plane_alone() -> None:
    host = container_config(
        structs.replace(PROXY, spec=ProxySpec(data_plane="kernel")), SETTINGS, "t", ""
    )["HostConfig"]
    assert host["CapAdd"] == ["NET_ADMIN"]
    assert host["CapDrop"] == ["ALL"]
    assert host["SecurityOpt"] == ["no-new-privileges:false"]
    assert host["ReadonlyRootfs"] is True
    assert not {"Privileged", "Binds", "Devices", "Sysctls"} & host.keys()
    for plane in ("auto", "splice", "copy"):
        spec = structs.replace(PROXY, spec=ProxySpec(data_plane=plane))
        host = container_config(spec, SETTINGS, "t", "")["HostConfig"]
        assert "CapAdd" not in host
        assert host["SecurityOpt"] == ["no-new-privileges:true"]


@pytest.mark.parametrize("plane", ["auto", "kernel", "splice", "copy"])
def test_the_proxy_is_told(plane: DataPlane) -> None:
    body = container_config(
        structs.replace(PROXY, spec=ProxySpec(data_plane=plane)), SETTINGS, "t", ""
    )
    told = [pair for pair in body["Env"] if pair.startswith("ROSPROXY_DATA_PLANE=")]
    assert told == ([] if plane == "auto" else [f"ROSPROXY_DATA_PLANE={plane}"])
    assert body["User"] == "10001:10001"


def test_the_sandbox_forwards_and_gets_no_capability() -> None:
    host = sandbox_config(structs.replace(SANDBOX, spec=ProxySpec(data_plane="kernel")), SETTINGS)[
        "HostConfig"
    ]
    assert host["Sysctls"] == {
        "net.ipv4.ip_local_port_range": "1024 11000",
        "net.ipv4.ip_forward": "1",
    }
    assert "CapAdd" not in host
    assert host["SecurityOpt"] == ["no-new-privileges:true"]
    assert "net.ipv4.ip_forward" not in sandbox_config(SANDBOX, SETTINGS)["HostConfig"]["Sysctls"]


def test_the_plan_names_the_capability() -> None:
    texts = [
        str(structs.replace(PROXY, spec=ProxySpec(data_plane=plane)))
        for plane in ("kernel", "splice")
    ]
    assert ["NET_ADMIN" in text for text in texts] == [True, False]


# what is changed


def test_all_is_as_it_ought_to_be() -> None:
    assert look(asking("a", "kernel"), existing_pair=own("kernel")).actions == ()
    assert look(asking("a", "splice"), existing_pair=own("splice")).actions == ()


def test_the_kernel_plane_makes_both_anew() -> None:
    plan = look(asking("a", "kernel"), existing_pair=own("auto"))
    assert made(plan.actions) == ([True], ["kernel"])


@pytest.mark.parametrize("plane", ["auto", "splice", "copy"])
def test_leaving_the_kernel_plane_leaves_no_rules_behind(plane: DataPlane) -> None:
    """A killed proxy leaves rules in the sandbox that the next proxy cannot remove."""
    plan = look(asking("a", plane), existing_pair=own("kernel"))
    assert made(plan.actions) == ([False], [plane])


def test_between_other_planes_the_sandbox_stays() -> None:
    plan = look(asking("a", "copy"), existing_pair=own("splice"))
    assert made(plan.actions) == ([], ["copy"])


def test_a_container_that_is_restarted_does_not_change_the_plane() -> None:
    pair = own("kernel")
    who = container("b"), asking("a", "kernel", state="exited")
    first = look(*who, existing_pair=pair)
    assert first.actions == ()
    assert look(*who, existing_pair=pair, memory=first.memory, now=59.0).actions == ()
    plan = look(*who, existing_pair=pair, memory=first.memory, now=60.0)
    assert made(plan.actions) == ([False], ["auto"])
