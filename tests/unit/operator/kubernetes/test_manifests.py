"""Created pods: hardened, bound to a node, and recognized later."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import hash_token
from rosproxy_operator.common.policy import POLICY_WAIT_S, administrators_policy
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.manifests import ProxySite
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.model import Json, MasterSpec, Name, Ros2Spec
from tests.run_options import settings_of
from tests.unit.operator.kubernetes.objects import RANGE, SETTINGS, node, rosproxy, site


def body(place: ProxySite | None = None, **changes: Any) -> Json:
    return manifests.proxy_pod(place or site(rosproxy(**changes), node()), SETTINGS)


def spec(place: ProxySite | None = None, **changes: Any) -> Json:
    return dict(body(place, **changes)["spec"])


def container(place: ProxySite | None = None, **changes: Any) -> Json:
    return dict(spec(place, **changes)["containers"][0])


def env(place: ProxySite | None = None, **changes: Any) -> dict[str, str]:
    return env_of(body(place, **changes))


def env_of(made: Json) -> dict[str, str]:
    return {
        variable["name"]: variable["value"] for variable in made["spec"]["containers"][0]["env"]
    }


def test_the_proxy_understands_all_of_its_variables() -> None:
    of = rosproxy(cleanup_after=0.5, slave_control="master")
    on = node(pod_networks=("10.244.1.0/24", "fd00::/64"))
    master = MasterSpec("http://roscore.ros.svc:1", "10.96.0.9", publish=999)
    place = ProxySite(of, on, "192.0.2.1", RANGE, master)
    settings = settings_of(env(place))
    assert settings.master_uri == "http://roscore.ros.svc:1"
    assert settings.master_address == "10.96.0.9"
    assert settings.advertise_host == "192.0.2.1"
    assert settings.ports.listen == settings.ports.advertise == RANGE
    assert (settings.master_port, settings.publish_master) == (11311, 999)
    assert str(settings.admin) == "0.0.0.0:11312"
    assert list(map(str, settings.inside_networks)) == ["10.244.1.0/24", "fd00::/64"]
    assert (settings.cleanup_after, settings.slave_control) == (0.5, "master")
    assert settings.admin_token is None


def test_its_policy_is_there_from_the_start_and_makes_no_pod_anew() -> None:
    """The administrator's layer comes first. The RosProxy's layer can only narrow the policy."""
    rules = parse_rules("deny publish /camera/*")
    settings = replace(SETTINGS, policy=administrators_policy([rules], "audit"))
    own = PolicyLayer("RosProxy ros/robot", parse_rules("deny serve *"))
    made = manifests.proxy_pod(site(rosproxy(policy=(own,)), node()), settings)
    assert settings_of(env_of(made)).policy_layers == (*settings.policy, own)
    assert manifests.fingerprint_of(made) == manifests.fingerprint_of(body())
    assert "ROSPROXY_POLICY_LAYERS" not in env()
    assert settings_of(env_of(made)).await_policy == POLICY_WAIT_S
    assert settings_of(env()).await_policy == 0.0


def test_what_is_not_known_is_left_to_the_proxy() -> None:
    names = env(site(rosproxy(), node(pod_networks=())))
    left_out = {"MASTER_ADDRESS", "PUBLISH_MASTER", "INSIDE_NETWORKS"}
    assert not {f"ROSPROXY_{name}" for name in left_out} & names.keys()


@pytest.mark.parametrize("plane", ["auto", "kernel", "splice", "copy"])
def test_it_is_told_how_to_forward(plane: str) -> None:
    variables = env(data_plane=plane)
    assert settings_of(variables).data_plane == plane
    assert ("ROSPROXY_DATA_PLANE" in variables) == (plane != "auto")


def test_a_log_level_recreates_the_pod() -> None:
    made = body(log_level="debug")
    assert settings_of(env_of(made)).log_level == "debug"
    assert "ROSPROXY_LOG_LEVEL" not in env()
    assert manifests.fingerprint_of(made) != manifests.fingerprint_of(body())


def test_clean_up_can_be_switched_off() -> None:
    assert settings_of(env(cleanup_after=0.0)).cleanup_after == 0.0


def test_each_port_is_the_same_on_the_node() -> None:
    assert container(site(rosproxy(), node(), publish=11500))["ports"] == [
        {"containerPort": port, "hostPort": port, "protocol": "TCP"}
        for port in (11400, 11401, 11402, 11403, 11500)
    ]


def test_ports_for_datagrams_are_those_of_the_range() -> None:
    made = container(site(rosproxy(direction="both", udp=True), node(), publish=11500))
    ports = {kind: {port["hostPort"] for port in made["ports"] if port["protocol"] == kind}
             for kind in ("TCP", "UDP")}  # fmt: skip
    assert ports["TCP"] == ports["UDP"] | {11500}
    assert {"name": "ROSPROXY_UDP", "value": "1"} in made["env"]


def test_the_port_of_the_lan_relay_is_no_port_of_the_proxy() -> None:
    made = container(site(rosproxy(ros2=Ros2Spec(multicast=True)), node()))
    ports = [(port["protocol"], port["hostPort"]) for port in made["ports"]]
    assert ports == [(kind, port) for kind in ("TCP", "UDP") for port in (11400, 11401, 11402)]


def test_it_can_do_nothing_that_it_need_not() -> None:
    pod = spec()
    box = container()
    assert pod["automountServiceAccountToken"] is False
    assert pod["enableServiceLinks"] is False
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["runAsUser"] == 10001
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert box["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert not {"hostNetwork", "hostPID", "hostIPC", "volumes", "priorityClassName"} & pod.keys()


def test_only_the_kernel_plane_may_make_rules() -> None:
    assert container(data_plane="kernel")["securityContext"] == {
        "allowPrivilegeEscalation": True,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"], "add": ["NET_ADMIN"]},
    }
    pod = spec(data_plane="kernel")
    assert pod["securityContext"] == spec()["securityContext"]
    assert pod["securityContext"]["runAsNonRoot"] is True
    for plane in ("splice", "copy"):
        assert container(data_plane=plane)["securityContext"] == container()["securityContext"]


def test_it_is_bound_to_its_node_but_placed_by_the_scheduler() -> None:
    pod = spec()
    assert "nodeName" not in pod
    required = pod["affinity"]["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"]
    field = {"key": "metadata.name", "operator": "In", "values": ["one"]}
    assert required == {"nodeSelectorTerms": [{"matchFields": [field]}]}


def test_it_stays_where_pods_of_daemon_sets_stay() -> None:
    own = {"key": "robot", "operator": "Exists", "effect": "NoSchedule"}
    tolerations = {
        (toleration["key"], toleration["effect"])
        for toleration in spec(tolerations=(own,))["tolerations"]
    }
    assert tolerations == {
        ("node.kubernetes.io/not-ready", "NoExecute"),
        ("node.kubernetes.io/unreachable", "NoExecute"),
        ("node.kubernetes.io/disk-pressure", "NoSchedule"),
        ("node.kubernetes.io/memory-pressure", "NoSchedule"),
        ("node.kubernetes.io/pid-pressure", "NoSchedule"),
        ("node.kubernetes.io/unschedulable", "NoSchedule"),
        ("robot", "NoSchedule"),
    }


def test_what_spec_says_goes_into_the_pod() -> None:
    more: dict[str, Any] = {
        "image": "rosproxy:7",
        "image_pull_policy": "Never",
        "image_pull_secrets": ({"name": "secret"},),
        "host_aliases": ({"ip": "192.0.2.9", "hostnames": ["robot"]},),
        "resources": {"requests": {"cpu": "1"}},
    }
    pod = spec(**more)
    box = container(**more)
    assert pod["imagePullSecrets"] == [{"name": "secret"}]
    assert pod["hostAliases"] == [{"ip": "192.0.2.9", "hostnames": ["robot"]}]
    assert (box["image"], box["imagePullPolicy"]) == ("rosproxy:7", "Never")
    assert box["resources"] == {"requests": {"cpu": "1"}}


def test_without_a_pull_policy_kubernetes_decides() -> None:
    assert "imagePullPolicy" not in container()


@pytest.mark.parametrize(
    ("ports", "local"),
    [
        (RANGE, "1024 11000"),
        (PortRange(2000, 2003), "32768 60999"),
        (PortRange(10998, 11001), "32768 60999"),
        (PortRange(40000, 40003), "1024 11000"),
    ],
)
def test_outgoing_connections_start_on_no_port_of_the_range(ports: PortRange, local: str) -> None:
    (sysctl,) = spec(site(rosproxy(), node(), ports))["securityContext"]["sysctls"]
    assert sysctl == {"name": "net.ipv4.ip_local_port_range", "value": local}


@pytest.mark.parametrize(
    ("ports", "domain", "publish", "local"),
    [
        (PortRange(40000, 40003), 0, 0, "40004 65535"),
        (PortRange(40000, 65535), 0, 0, "11313 19999"),
        (PortRange(11400, 32000), 0, 40000, "40001 65535"),
        (PortRange(2000, 2003), 102, 0, "32911 65535"),
    ],
)
def test_outgoing_connections_start_on_no_port_of_stand_ins(
    ports: PortRange, domain: int, publish: int, local: str
) -> None:
    """With the former range 12000-30000 a connection could take the port of a stand-in."""
    of = rosproxy(ros2=Ros2Spec(domain))
    (sysctl,) = spec(site(of, node(), ports, publish))["securityContext"]["sysctls"]
    assert sysctl["value"] == local


def test_the_master_in_the_cluster_counts_too() -> None:
    context = spec(site(rosproxy(), node(), publish=2000))["securityContext"]
    assert context["sysctls"][0]["value"] == "32768 60999"


def test_a_pod_is_read_back_as_it_was_made() -> None:
    made = body(replace(site(rosproxy(), node()), token_hash="5e884898da28"))
    proxy = objects.proxy_pod({**made, "metadata": {**made["metadata"], "uid": "u"}, "status": {}})
    assert proxy is not None
    assert (proxy.of, proxy.owner, proxy.node) == (rosproxy().id, "uid-robot", "one")
    assert (proxy.range, proxy.image, proxy.token) == (RANGE, "rosproxy:1", "")
    assert proxy.fingerprint == manifests.fingerprint_of(made)
    assert proxy.pod.host_ports == set(RANGE.ports())


def test_it_is_told_the_hash_of_its_token_alone() -> None:
    token = names.token_of(b"k" * 32, names.proxy_id(rosproxy().id, "one"), "one")
    made = body(replace(site(rosproxy(), node()), token_hash=hash_token(token)))
    assert settings_of(env_of(made)).token_hash == hash_token(token)
    assert token not in str(made)


def test_each_proxy_has_a_token_of_its_own() -> None:
    proxies = [(Name("ros", "a"), "one"), (Name("ros", "a"), "two"), (Name("arm", "a"), "one")]
    tokens = {names.token_of(key, *proxy) for proxy in proxies for key in (b"k" * 32, b"l" * 32)}
    assert len(tokens) == 6
    assert names.token_of(b"", *proxies[0]) == ""


@pytest.mark.parametrize(
    ("everywhere", "own", "holds"),
    [("any", "any", "any"), ("any", "master", "master"), ("master", "any", "master")],
)
def test_a_rosproxy_may_only_narrow_who_controls_its_nodes(
    everywhere: str, own: str, holds: str
) -> None:
    settings = replace(SETTINGS, bounds=replace(SETTINGS.bounds, slave_control=everywhere))
    made = manifests.proxy_pod(site(rosproxy(slave_control=own), node()), settings)
    assert settings_of(env_of(made)).slave_control == holds


def test_a_fingerprint_tells_whether_nodes_are_found_again() -> None:
    own = manifests.fingerprint_of(body())
    same = manifests.fingerprint_of(body(cleanup_after=1.0))
    assert manifests.keeps_registrations(own, same)
    assert manifests.keeps_registrations("", own)
    for other in (body(master=MasterSpec("http://arm:11311")),
                  body(site(rosproxy(), node(advertise_host="gate")))):  # fmt: skip
        assert not manifests.keeps_registrations(own, manifests.fingerprint_of(other))


def test_it_goes_on_for_a_moment_after_its_deletion() -> None:
    assert container()["lifecycle"] == {"preStop": {"exec": {"command": ["sleep", "2"]}}}
    assert spec()["terminationGracePeriodSeconds"] > 2


def test_the_fingerprint_does_not_depend_on_the_image() -> None:
    bodies = [body(), body(image="rosproxy:2")]
    assert len({manifests.fingerprint_of(manifest) for manifest in bodies}) == 1


@pytest.mark.parametrize(
    "other",
    [
        site(rosproxy(), node("two")),
        site(rosproxy(uid="other"), node()),
        site(rosproxy("arm"), node()),
        site(rosproxy(), node(advertise_host="gate")),
        site(rosproxy(), node(pod_networks=())),
        site(rosproxy(), node(), PortRange(11400, 11404)),
        site(rosproxy(), node(), publish=11500),
        site(rosproxy(master=MasterSpec("http://arm:11311")), node()),
        site(rosproxy(master=MasterSpec("http://robot:11311", "192.0.2.7")), node()),
        site(rosproxy(cleanup_after=1.0), node()),
        site(rosproxy(image_pull_policy="Never"), node()),
        replace(site(rosproxy(), node()), token_hash="other"),
    ],
)
def test_the_fingerprint_depends_on_all_else(other: ProxySite) -> None:
    assert manifests.fingerprint_of(body(other)) != manifests.fingerprint_of(body())


def test_a_service_leads_to_the_proxy_on_the_callers_own_node() -> None:
    service = manifests.service(rosproxy())
    assert service["spec"]["internalTrafficPolicy"] == "Local"
    assert service["spec"]["publishNotReadyAddresses"] is True
    assert service["spec"]["selector"] == body()["metadata"]["labels"]
    assert [(port["port"], port["targetPort"]) for port in service["spec"]["ports"]] == [
        (11311, 11311)
    ]


def test_a_rosproxy_chooses_no_name_and_no_address_of_its_service() -> None:
    """The master's host is a name only for the RosProxy's proxies, and for pods that ask for it."""
    alias = {"ip": "192.0.2.9", "hostnames": ["db"]}
    made = manifests.service(rosproxy(master=MasterSpec("http://db:5432"), host_aliases=(alias,)))
    assert made["metadata"]["name"] == "rosproxy-robot"
    assert made["spec"].keys() == {
        *("type", "selector", "internalTrafficPolicy", "publishNotReadyAddresses", "ports")
    }
    assert made["spec"]["type"] == "ClusterIP"
    assert "db" not in str(made)


def test_a_service_is_read_back_as_it_was_made() -> None:
    made = manifests.service(rosproxy(), "10.96.1.1")
    service = objects.service({**made, "metadata": {**made["metadata"], "uid": "u"}})
    assert service is not None
    assert (service.of, service.owner, service.cluster_ip) == (
        rosproxy().id,
        "uid-robot",
        "10.96.1.1",
    )
    assert service.fingerprint == manifests.fingerprint_of(manifests.service(rosproxy()))


def test_a_service_can_do_without_its_former_address() -> None:
    made = manifests.service(rosproxy(), "10.96.1.1")
    assert manifests.without_cluster_ip(made) == manifests.service(rosproxy())


@pytest.mark.parametrize("made", [body(), manifests.service(rosproxy())])
def test_all_goes_with_its_rosproxy(made: Json) -> None:
    (owner,) = made["metadata"]["ownerReferences"]
    assert (owner["kind"], owner["uid"], owner["controller"]) == ("RosProxy", "uid-robot", True)
    assert "finalizers" not in made["metadata"]


def test_the_default_policy_is_that_of_the_settings() -> None:
    settings = replace(SETTINGS, image_pull_policy="Always")
    made = manifests.proxy_pod(site(rosproxy(), node()), settings)
    assert made["spec"]["containers"][0]["imagePullPolicy"] == "Always"
