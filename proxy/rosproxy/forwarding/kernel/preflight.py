"""Whether the proxy may use the kernel plane in its network namespace."""

import sys
from collections.abc import Iterator
from pathlib import Path

from rosproxy.forwarding.kernel.decisions import HostForwarding
from rosproxy.forwarding.kernel.nft import NftError, dropping_chains
from rosproxy.forwarding.kernel.tools import ToolError, Tools
from rosproxy.shared.fixes import how_to
from rosproxy.shared.setting_kinds import DataPlane

_INTERFACES = Path("/sys/class/net")
_LEGACY_TABLES = Path("/proc/net/ip_tables_names")
_IPV4_FORWARDING = Path("/proc/sys/net/ipv4/ip_forward")
_IPV6_FORWARDING = Path("/proc/sys/net/ipv6/conf/all/forwarding")


def read_forwarding() -> HostForwarding:
    """Read which IP versions this network namespace forwards, and the largest MTU in bytes."""
    return HostForwarding(
        ipv4=_read(_IPV4_FORWARDING) == "1",
        ipv6=_read(_IPV6_FORWARDING) == "1",
        longest_packet=_longest_packet(),
    )


async def find_obstacle(mode: DataPlane, tools: Tools) -> str | None:
    """The reason against the kernel plane, with advice; None if the proxy may use the plane.

    ``auto`` does not use the kernel plane in the network of a host: there the table of the proxy
    would see the connections of all programs.
    """
    for reason in _reasons(mode):
        return reason
    try:
        chains = dropping_chains(await tools.nft("-j", "list", "chains"))
    except (ToolError, NftError) as error:
        return str(error)
    if chains:
        return (
            "another firewall in this network namespace drops forwarded packets "
            f"({', '.join(chains)}): run the proxy in a network namespace of its own"
        )
    return None


def _reasons(mode: DataPlane) -> Iterator[str]:
    if sys.platform != "linux":
        yield "forwarding in the kernel needs Linux"
        return
    if mode == "auto" and (hardware := _hardware_interface()):
        yield (
            f"the proxy seems to run in the host's network (interface {hardware}), where "
            "the data plane auto does not use the kernel: run the proxy in a network namespace of "
            f"its own, or {how_to('kernel plane')}"
        )
    host = read_forwarding()
    if not (host.ipv4 or host.ipv6):
        yield (
            "net.ipv4.ip_forward is not 1 in the proxy's network namespace: "
            f"{how_to('kernel forwards')}"
        )
    # nft does not list the chains of iptables-legacy, so `dropping_chains` can't see their policy.
    if "filter" in _read(_LEGACY_TABLES).split():
        yield (
            "iptables-legacy has a filter table in this network namespace, which may drop "
            "forwarded packets: use iptables-nft, or run the proxy in a network namespace of its "
            "own"
        )


def _hardware_interface() -> str | None:
    """The name of the first hardware network interface; None with only virtual interfaces."""
    return next((path.name for path in _interfaces() if (path / "device").exists()), None)


def _longest_packet() -> int:
    """Return the largest MTU of the interfaces in bytes, loopback aside; 0 without interfaces."""
    texts = (_read(path / "mtu") for path in _interfaces() if path.name != "lo")
    return max((int(text) for text in texts if text), default=0)


def _interfaces() -> list[Path]:
    try:
        return sorted(_INTERFACES.iterdir())
    except OSError:
        return []


def _read(path: Path) -> str:
    """The text of a file; empty if the file is missing or unreadable."""
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return ""
