"""Invariants of a cluster with a controller: at any moment, and at rest."""

import copy
from collections.abc import Iterator

from msgspec.structs import replace

from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import hash_token
from rosproxy_operator.kubernetes.planner.actions import CreateProxy, DeleteProxy
from rosproxy_operator.kubernetes.planner.plan import ClusterPlan
from rosproxy_operator.kubernetes.planner.pods.selection import on_node, select_rosproxy, selects
from rosproxy_operator.kubernetes.planner.steps.network_policy import policy
from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources import spec as parse_rosproxy
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot, ProxyPod
from rosproxy_operator.kubernetes.resources.model import Name, ProxyPlace, RosProxy
from tests.unit.operator.kubernetes.simulation import (
    BAD_IMAGE,
    NAMESPACE,
    SETTINGS,
    Cluster,
    Controller,
    Object,
    component_of,
    deleting,
    ended,
    host_ports,
    is_own,
    meta,
    name_of,
    node_of,
)

NODES = {"one": "192.0.2.1", "two": "192.0.2.2", "three": "192.0.2.3"}
FIRST = 11400


def spec(number: int = 0) -> Object:
    return {
        "master": {"uri": "http://robot:11311"},
        "ports": 2 + number % 2,
        "portWindow": {"first": FIRST, "last": FIRST + 11},
        "graceSeconds": 10,
    }


def container_of(pod: Object) -> Object:
    container: Object = pod["spec"]["containers"][0]
    return container


class World:
    """A cluster with a controller, and what must always hold there."""

    def __init__(self, namespace: str = NAMESPACE, names: dict[str, str] = NODES) -> None:
        self.namespace = namespace
        self.names = names
        self.cluster = Cluster(namespace)
        self.controller = Controller(self.cluster, SETTINGS)
        for name, ip in list(names.items())[:2]:
            self.cluster.add_node(name, ip)
        self.cluster.add_rosproxy("robot", spec())
        self.pods = 0
        self.served_ranges: dict[ProxyPlace, PortRange] = {}
        self.may_move: set[ProxyPlace] = set()

    @property
    def nodes(self) -> list[str]:
        return sorted(self.cluster.state.nodes)

    def own(self) -> list[Object]:
        return [pod for pod in self.cluster.state.pods.values() if is_own(pod)]

    def users(self) -> list[Object]:
        return [pod for pod in self.cluster.state.pods.values() if not is_own(pod)]

    def proxies(self) -> Iterator[tuple[Object, ProxyPod]]:
        for pod in self.own():
            if component_of(pod) != names.PROXY:
                continue
            proxy = objects.proxy_pod(pod)
            assert proxy is not None
            yield pod, proxy

    def statuses(self) -> dict[str, str]:
        """The status and the real address of each pod, by uid."""
        addresses = self.cluster.addresses
        pods = ((meta(pod)["uid"], pod) for pod in self.cluster.state.pods.values())
        return {uid: f"{pod['status']} {addresses.get(uid)}" for uid, pod in pods}

    # what the operator does

    def observe(self) -> ClusterSnapshot:
        """The operator's snapshot."""
        snapshot = self.cluster.observe(self.controller.old, self.controller.failures)
        selected = (
            pod for pod in snapshot.pods if any(selects(of, pod) for of in snapshot.rosproxies)
        )
        return replace(
            snapshot,
            selected=frozenset(pod.uid for pod in selected),
            misspelt_pods=tuple(pod for pod in snapshot.pods if pod.misspelt),
        )

    def in_status(self, place: ProxyPlace) -> PortRange | None:
        rosproxy = self.cluster.state.rosproxies.get(place.of)
        return parse_rosproxy.rosproxy(rosproxy).former_ranges.get(place.node) if rosproxy else None

    def seen(self) -> ClusterPlan:
        """A look, which must not take a pod for gone that runs."""
        plan = self.controller.look()
        pods = self.cluster.state.pods.values()
        live = {meta(pod)["uid"] for pod in pods if not ended(pod)}
        live_addresses = {ip for uid, ip in self.cluster.addresses.items() if uid in live}
        assert not live_addresses & {
            ip for briefing in plan.briefings.values() for ip in briefing.gone
        }, "it runs"
        return plan

    def carry_out(self, plan: ClusterPlan, most: int | None = None) -> None:
        for action in plan.actions:
            if isinstance(action, CreateProxy):
                self.check_new_range(action)
                assert self.seen_ready(self.place_of(action).node)
            elif isinstance(action, DeleteProxy):
                on = {proxy.pod.uid: proxy.node for _, proxy in self.proxies()}.get(action.uid, "")
                gone = action.why == "its RosProxy is gone"
                assert gone or on not in self.nodes or self.seen_ready(on)
        self.controller.carry_out(plan, most)

    def seen_ready(self, node: str) -> bool:
        """Whether a node is ready, as far as the operator sees."""
        nodes = (self.controller.old or self.cluster.state).nodes
        return node not in nodes or nodes[node]["status"]["conditions"][0]["status"] == "True"

    # what must hold

    def place_of(self, action: CreateProxy) -> ProxyPlace:
        return ProxyPlace(action.of, action.body["metadata"]["annotations"][names.NODE])

    def check_new_range(self, action: CreateProxy) -> None:
        place = self.place_of(action)
        text = action.body["metadata"]["annotations"][names.PORT_RANGE]
        first, last = map(int, text.split("-"))
        assert self.is_lawful(action.of, PortRange(first, last))
        before = self.served_ranges.get(place)
        if before is None and self.in_status(place) is None:
            seen = self.controller.old or self.cluster.state
            pods_on_node = [pod for pod in seen.pods.values() if node_of(pod) == place.node]
            other_pods = (pod for pod in pods_on_node if not ended(pod) and not is_own(pod))
            of = parse_rosproxy.rosproxy(self.cluster.state.rosproxies[action.of])
            taken = {port for pod in other_pods for port in objects.pod(pod).ports_of(of.spec)}
            assert not taken.intersection(range(first, last + 1)), "other pods hold these ports"
        if before is not None and place not in self.may_move:
            count = self.cluster.state.rosproxies[action.of]["spec"]["ports"]
            cut = PortRange(before.first, min(before.last, before.first + count - 1))
            if self.is_lawful(action.of, cut):
                assert before.first == first, f"{place} moves from {before} to {text}"

    def is_lawful(self, of: Name, ports: PortRange) -> bool:
        """Whether the RosProxy allows a range."""
        spec = self.cluster.state.rosproxies[of]["spec"]
        if spec.get("ros") == "zenoh":
            return ports == names.ROUTERS
        publish = (spec["master"] or {}).get("publish", 0)
        own = {names.MASTER_PORT, names.ADMIN_PORT, publish}
        inside = (
            spec["portWindow"]["first"] <= ports.first and ports.last <= spec["portWindow"]["last"]
        )
        return inside and not any(port in ports for port in own)

    def note_conflicts(self) -> None:
        """A proxy may move if its ports are refused, or if another pod has them."""
        for place, ports in self.served_ranges.items():
            other_pods = [
                pod
                for state in (self.cluster.state, self.controller.old)
                for pod in (state.pods.values() if state else ())
                if place.node in (node_of(pod), meta(pod).get("annotations", {}).get(names.NODE))
                and name_of(pod) != names.proxy_id(place.of, place.node)
                and name_of(pod) != names.lan_relay_id(place.of, place.node)
            ]
            taken = {port for pod in other_pods for port in objects.pod(pod).every_port}
            refused = {port for node, port in self.controller.state.taken if node == place.node}
            if any(port in ports for port in taken | refused):
                self.may_move.add(place)
        for _, proxy in self.proxies():
            if proxy.stuck is not None:
                self.may_move.add(ProxyPlace(proxy.of, proxy.node))

    def check(self) -> None:
        """Check the invariants of any moment."""
        self.note_conflicts()
        live_places: list[ProxyPlace] = []
        for pod, proxy in self.proxies():
            place = ProxyPlace(proxy.of, proxy.node)
            if not ended(pod) and not deleting(pod):
                live_places.append(place)
            if pod["status"]["phase"] == "Running" and place.of in self.cluster.state.rosproxies:
                uid = meta(self.cluster.state.rosproxies[place.of])["uid"]
                if proxy.owner == uid and place.node in self.nodes:
                    self.served_ranges[place] = proxy.range
                    self.may_move.discard(place)
        assert len(live_places) == len(set(live_places)), "one proxy for each RosProxy on a node"
        for node in self.nodes:
            pods = [p for p in self.cluster.state.pods.values() if node_of(p) == node]
            ports = [port for p in pods if not ended(p) for port in sorted(host_ports(p))]
            assert len(ports) == len(set(ports))

    def come_to_rest(self, _n: int = 0, _m: int = 0) -> None:
        """Nothing else happens: everything must be as wished after some looks."""
        self.cluster.forbidden = False
        self.controller.old = None
        self.cluster.step()
        self.check()
        self.cluster.made = 0
        for _ in range(100):
            plan = self.seen()
            self.carry_out(plan)
            statuses = self.statuses()
            self.cluster.step()
            self.check()
            # A pod with another status makes the operator look again.
            if not plan.actions and plan.next_look_in is None and statuses == self.statuses():
                break
            self.controller.now += 1.0 if plan.next_look_in is None else plan.next_look_in
        else:
            raise AssertionError(f"never comes to rest: {plan.actions} {plan.next_look_in}")
        assert self.cluster.made <= 40, "the operator repeats actions for ever"
        self.check_all_is_as_wished(plan)

    def check_all_is_as_wished(self, plan: ClusterPlan) -> None:
        state = self.cluster.state
        rosproxies = [parse_rosproxy.rosproxy(copy.deepcopy(r)) for r in state.rosproxies.values()]
        wanted = set()
        for pod in map(objects.pod, state.pods.values()):
            of = select_rosproxy(pod, rosproxies)
            node = state.nodes.get(pod.node)
            if (
                isinstance(of, RosProxy)
                and node
                and not pod.ended
                and not pod.deleting
                and on_node(of, objects.node(node))
            ):
                wanted.add(ProxyPlace(of.id, pod.node))
        unready = {node for node in self.nodes if not self.cluster.is_ready(node)}
        self.check_proxies(plan, {place for place in wanted if place.node not in unready}, unready)
        services = [service for service in state.services.values() if is_own(service)]
        owners = sorted(service["metadata"]["ownerReferences"][0]["uid"] for service in services)
        uids = sorted(rosproxy.uid for rosproxy in rosproxies)
        with_hubs = [rosproxy.uid for rosproxy in rosproxies if rosproxy.spec.zenoh]
        with_port = [r.uid for r in rosproxies if r.spec.zenoh and r.spec.zenoh.listen]
        assert owners == sorted([*uids, *with_hubs, *with_port])
        policies = state.policies.values()
        assert sorted(p["metadata"]["ownerReferences"][0]["uid"] for p in policies) == uids
        for rosproxy in rosproxies:
            stored_policy = objects.policy(state.policies[names.policy_id(rosproxy.id)])
            assert stored_policy is not None
            assert stored_policy.spec == policy(rosproxy, SETTINGS)["spec"]
        self.check_addresses(unready)
        self.check_lan_relays(plan, unready)

    def check_lan_relays(self, plan: ClusterPlan, unready: set[str]) -> None:
        """Exactly the proxies with multicast have a LAN relay, which knows the proxy's address.

        If a finding reports an obstacle, the proxy stays, and gets no LAN relay meanwhile.
        """
        lan_relays = {}
        for pod in self.own():
            lan_relay = objects.helper_pod(pod)
            if lan_relay and lan_relay.component == names.LAN_RELAY:
                lan_relays[ProxyPlace(lan_relay.of, lan_relay.node)] = pod, lan_relay
        wanted = {}
        for _, proxy in self.proxies():
            of = self.cluster.state.rosproxies.get(proxy.of)
            if of and of["spec"].get("multicast"):
                wanted[ProxyPlace(proxy.of, proxy.node)] = proxy
        assert {p for p in lan_relays if p.node not in unready} <= wanted.keys()
        for place, proxy in wanted.items():
            if place.node in unready or not proxy.pod.ip or self.obstacles(plan, place):
                continue
            env = {
                variable["name"]: variable["value"]
                for variable in container_of(lan_relays[place][0])["env"]
            }
            assert env["ROSPROXY_LAN_RELAY_PROXY"] == f"{proxy.pod.ip}:{proxy.range.first}"
            secret = names.relay_secret_of(self.cluster.key, proxy.pod.id, place.node)
            assert env["ROSPROXY_LAN_RELAY_SECRET"] == secret
            assert env["ROSPROXY_LAN_RELAY_BIND"] == f"{self.names[place.node]}:{proxy.range.last}"
            assert proxy.range.last not in proxy.pod.udp_ports

    def check_proxies(self, plan: ClusterPlan, wanted: set[ProxyPlace], unready: set[str]) -> None:
        proxies = {ProxyPlace(proxy.of, proxy.node): (pod, proxy) for pod, proxy in self.proxies()}
        assert {place for place in proxies if place.node not in unready} <= wanted
        for place in wanted:
            rosproxy = self.cluster.state.rosproxies[place.of]["spec"]
            if self.obstacles(plan, place):
                continue
            pod, proxy = proxies[place]
            assert not deleting(pod)
            container = pod["spec"]["containers"][0]
            image = rosproxy.get("image", "rosproxy:1")
            assert container["image"] == image or image == BAD_IMAGE
            assert pod["status"]["phase"] == "Running" or container["image"] == BAD_IMAGE
            if (
                container["image"] != image
            ):  # no proxy changes before the image was usable on a node
                told = [(problem.reason, problem.of) for problem in plan.problems]
                assert ("ImageUnusable", place.of) in told
                continue
            has_all = len(proxy.range) == rosproxy["ports"] or proxy.range == names.ROUTERS
            assert has_all or self.told(plan, place, "PortsExhausted")
            env = {variable["name"]: variable["value"] for variable in container["env"]}
            self.check_versions(place, proxy, env)
            token = names.token_of(self.cluster.key, proxy.pod.id, place.node)
            assert env["ROSPROXY_ADMIN_TOKEN_HASH"] == hash_token(token)
            service = "http://roscore.ros.svc:11311"
            master = rosproxy["master"]
            assert env.get("ROS_MASTER_URI") == (master and master.get("uri", service))
            publish = master and master.get("publish")
            if publish and not self.told(plan, place, "PortConflict"):
                assert env["ROSPROXY_PUBLISH_MASTER"] == str(publish)

    def check_versions(self, place: ProxyPlace, proxy: ProxyPod, env: dict[str, str]) -> None:
        """The proxy has the wanted versions of ROS, and ports of the protocols for these."""
        spec = parse_rosproxy.rosproxy(self.cluster.state.rosproxies[place.of]).spec
        assert bool(proxy.pod.host_ports) == spec.ros1
        assert bool(proxy.pod.udp_ports) == (spec.ros2 is not None)
        assert (proxy.range == names.ROUTERS) == (spec.zenoh is not None)
        assert (env.get("ROSPROXY_ROS") == "zenoh") == (spec.zenoh is not None)
        secret = names.relay_secret_of(self.cluster.key, proxy.pod.id, place.node)
        expected = secret if "ROSPROXY_ROS2_LAN_RELAY" in env else None
        assert env.get("ROSPROXY_ROS2_LAN_RELAY_SECRET") == expected
        domain = str(spec.ros2.number) if spec.ros2 else None
        assert env.get("ROSPROXY_ROS2_DOMAINS") == domain

    def obstacles(self, plan: ClusterPlan, place: ProxyPlace) -> bool:
        reasons = ("MasterUnknown", "NoAdvertiseHost", "NameTaken")
        fatal = self.told(plan, place, "PortsExhausted", fatal=True)
        return fatal or any(self.told(plan, place, reason) for reason in reasons)

    def told(
        self, plan: ClusterPlan, place: ProxyPlace, reason: str, fatal: bool | None = None
    ) -> bool:
        return any(
            finding.reason == reason
            and finding.of == place.of
            and place.node in f"{finding.subject} {finding.text}".split(": ")[0] + finding.text
            and fatal in (None, finding.fatal)
            for finding in plan.problems
        )

    def check_addresses(self, unready: set[str]) -> None:
        """A proxy knows no ROS node of a pod that is gone."""
        for pod, proxy in self.proxies():
            if proxy.node in unready or proxy.pod.uid not in self.cluster.running():
                continue
            live = [p for p in self.users() if node_of(p) == proxy.node and not ended(p)]
            live_addresses = {self.cluster.addresses[meta(p)["uid"]] for p in live}
            assert self.cluster.ros.get(meta(pod)["uid"], set()) <= live_addresses
