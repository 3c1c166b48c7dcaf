"""The redirect for containers of rmw_zenoh: connections to a router lead to the proxy instead.

Nodes of rmw_zenoh look for a router at localhost:7447. A router passes no data between two peers
of the same router. So the proxy runs a separate router, at a separate port, for each network
namespace. The operator has no disk: the range of the redirect's record holds this port.

A connection to localhost leaves the namespace only with the sysctl ``route_localnet``. With this
sysctl alone, neighbours could reach programs that listen on loopback (CVE-2020-8558). So a rule
drops packets that arrive from the network with a loopback address.

A node may have opened a session with a router outside before the redirect. If this session stayed,
that router would pass no data between the node and the other peers of the router. So the rules
reset the session.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import count
from string import Template

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.setting_kinds import ZENOH_PORT
from rosproxy_operator.common.zenoh import OVERRIDE, client_override
from rosproxy_operator.docker.planner.model import Container, Member, RedirectContainer
from rosproxy_operator.proxy_spec.place import ZENOH

LOCAL_ROUTER = HostPort("127.0.0.1", ZENOH_PORT)
"""The address at which nodes of rmw_zenoh look for a router by default."""
FIRST_PORT = ZENOH_PORT + 1
"""The lowest port of the proxy's routers for containers."""
ROUTE_LOCALNET = "net.ipv4.conf.all.route_localnet"
# Priority -300 is before conntrack (-200). So the guard does not drop replies to redirected
# connections: conntrack has not restored the loopback addresses in these replies yet.
_ROUTER_RULES = Template("""\
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
# In the hook output, redirected packets already have the proxy's address and match no rule. In the
# hook input, redirected packets have the router's address again, so `ct status dnat` comes first.
_RESET_CHAINS = Template("""\
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
    """Return the nftables table that leads connections to ``routers`` to a port of the proxy.

    The rules reset older sessions with routers outside.
    """
    every = [*routers]
    outside = [router for router in every if router != LOCAL_ROUTER]
    reset = "reject with tcp reset"
    resets = _RESET_CHAINS.substitute(
        out="\n".join(f"    ip daddr {r.host} tcp dport {r.port} {reset}" for r in outside),
        in_="\n".join(f"    ip saddr {r.host} tcp sport {r.port} {reset}" for r in outside),
    )
    return _ROUTER_RULES.substitute(
        table=table,
        redirects="\n".join(
            f"    ip daddr {r.host} tcp dport {r.port} dnat to {proxy}" for r in every
        ),
        proxy=proxy.host,
        port=proxy.port,
        resets=resets if outside else "",
    )


def zenoh_sysctls(is_set: bool) -> dict[str, str]:
    """Return the sysctls of a network namespace: with a redirect if ``is_set``, else without."""
    return {ROUTE_LOCALNET: str(int(is_set))}


def as_client(proxy: str) -> str:
    """Return the variable that makes nodes use the proxy, given by name, without a redirect."""
    return f"{OVERRIDE}='{client_override(HostPort(proxy, FIRST_PORT))}'"


def with_all_routers(
    placed: Collection[tuple[Member, Container]],
) -> Iterator[tuple[Member, Container]]:
    """Yield each member with the routers of all members in the same network namespace.

    ``placed`` pairs each member with the container that owns the network namespace.
    """
    for member, owner in placed:
        near = (other.redirected for other, other_owner in placed if other_owner.id == owner.id)
        routers = dict.fromkeys(sorted((router for routers in near for router in routers), key=str))
        yield replace(member, redirected=tuple(routers)), owner


def router_ports(
    records: Iterable[RedirectContainer], targets: frozenset[str]
) -> Mapping[str, int]:
    """Return the proxy's port for each network namespace, by the id of the owning container.

    A network namespace keeps the port of its record. ``targets`` are the ids of all owners.
    """
    ports: dict[str, int] = {}
    for record in records:
        target = record.container.network_container or ""
        port = record.range.first
        if record.place == ZENOH and target in targets and port not in ports.values():
            ports.setdefault(target, port)
    free = (port for port in count(FIRST_PORT) if port not in {*ports.values()})
    for target in sorted(targets - ports.keys()):
        ports[target] = next(free)
    return ports
