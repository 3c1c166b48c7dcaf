"""The redirect of a container of rmw_zenoh: the routers that its nodes look for lead to the proxy.

Nodes of rmw_zenoh look for a router at localhost:7447. A router passes no data between two of its
own peers, so each network namespace has a router of its own at the proxy, at a port of its own. The
record of a redirect has this port as its range, since the operator has no disk.

A connection to localhost leaves the namespace only with the sysctl ``route_localnet``. With this
sysctl, neighbours could reach what listens on loopback there (CVE-2020-8558), so a rule drops that.

A session that a node has opened with a router outside before the redirect would stay, and a router
passes no data between the node and its own peers. So the rules reset such a session.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import count
from string import Template

from rosproxy.net.addresses import HostPort
from rosproxy.setting_kinds import ZENOH_PORT
from rosproxy_operator.docker.planner.model import ZENOH, Container, Member, RedirectContainer

LOCAL_ROUTER = HostPort("127.0.0.1", ZENOH_PORT)
"""Where nodes of rmw_zenoh look for a router by default."""
FIRST_PORT = ZENOH_PORT + 1
"""The first port of the proxy for containers."""
ROUTE_LOCALNET = "net.ipv4.conf.all.route_localnet"
# The guard sees packets before conntrack: answers to redirected connections do not have their
# loopback addresses back yet.
_SET = Template("""\
table ip $table {
  chain guard {
    type filter hook prerouting priority -300; policy accept;
    iifname != "lo" ip daddr 127.0.0.0/8 drop
    iifname != "lo" ip saddr 127.0.0.0/8 drop
  }
  chain output {
    type nat hook output priority -100; policy accept;
$redirects
  }
  chain postrouting {
    type nat hook postrouting priority 100; policy accept;
    ip daddr $proxy tcp dport $port ct status dnat masquerade
  }
$resets}
""")
# In these hooks redirected packets have the proxy's address on the way out, and their first address
# again on the way in.
_RESETS = Template("""\
  chain resets_out {
    type filter hook output priority 0; policy accept;
$out
  }
  chain resets_in {
    type filter hook input priority 0; policy accept;
    ct status dnat accept
$in_
  }
""")


def zenoh_rules(table: str, routers: Iterable[HostPort], proxy: HostPort) -> str:
    """The table of nftables that leads these routers to a port of the proxy."""
    every = [*routers]
    outside = [router for router in every if router != LOCAL_ROUTER]
    reset = "reject with tcp reset"
    resets = _RESETS.substitute(
        out="\n".join(f"    ip daddr {r.host} tcp dport {r.port} {reset}" for r in outside),
        in_="\n".join(f"    ip saddr {r.host} tcp sport {r.port} {reset}" for r in outside),
    )
    return _SET.substitute(
        table=table,
        redirects="\n".join(
            f"    ip daddr {r.host} tcp dport {r.port} dnat to {proxy}" for r in every
        ),
        proxy=proxy.host,
        port=proxy.port,
        resets=resets if outside else "",
    )


def zenoh_sysctls(is_set: bool) -> dict[str, str]:
    """The sysctls of a network namespace with or without a redirect."""
    return {ROUTE_LOCALNET: str(int(is_set))}


def as_client(proxy: str) -> str:
    """The variable by which nodes use the proxy, by its name, without a redirect."""
    return (
        f"""ZENOH_CONFIG_OVERRIDE='mode="client";connect/endpoints=["tcp/{proxy}:{FIRST_PORT}"]'"""
    )


def with_all_routers(
    placed: Collection[tuple[Member, Container]],
) -> Iterator[tuple[Member, Container]]:
    """The members with the routers that all members in the same network namespace look for."""
    for member, owner in placed:
        near = (other.redirected for other, place in placed if place.id == owner.id)
        routers = dict.fromkeys(sorted((router for routers in near for router in routers), key=str))
        yield replace(member, redirected=tuple(routers)), owner


def router_ports(
    records: Iterable[RedirectContainer], targets: frozenset[str]
) -> Mapping[str, int]:
    """The port of the proxy for each network namespace, by the id of the container that owns it.

    A container keeps the port that its record has.
    """
    ports: dict[str, int] = {}
    for record in records:
        target = record.container.network_container or ""
        port = record.range.first
        if record.key == ZENOH and target in targets and port not in ports.values():
            ports.setdefault(target, port)
    free = (port for port in count(FIRST_PORT) if port not in {*ports.values()})
    for target in sorted(targets - ports.keys()):
        ports[target] = next(free)
    return ports
