"""The rule about the ``Host`` of a request: no web page of a stranger may ask through a browser.

A stranger's web page can let its own name lead to the admin endpoint (DNS rebinding). The browser
then takes the endpoint for that page's own server, and lets the page read the replies. No header
tells such a request from that of a program: a page of the same origin sends no ``Origin``, and over
HTTP a browser sends no ``Sec-Fetch-Site``. But the browser names the host that the page has asked
for. So a request must name an address, a name that no stranger can register, or a name that the
proxy is known by. A request that has proved to know the token is a program's, whatever it names.
"""

from collections.abc import Collection

from rosproxy.net.addresses import is_address, parse_authority
from rosproxy.telemetry.text import brief

LOCAL = (".localhost", ".local", ".internal", ".svc")
"""Ends of names that are nobody's on the Internet. Service names of Kubernetes end in ``.svc`` or
``.svc.cluster.local``."""
LONGEST_SHOWN = 100
"""Characters of a refused name that the refusal repeats."""


def is_own_host(host: str, own_names: Collection[str] = ()) -> bool:
    """Whether the ``Host`` of a request is none that a stranger may have registered.

    ``own_names`` are those that the proxy is known by, in lower case. A browser always sends a
    ``Host``, so that a request without one is a program's.
    """
    host_port = parse_authority(f"//{host}")
    name = (host_port.host if host_port else host.partition(":")[0]).lower().rstrip(".")
    return (
        is_address(name.strip("[]")) or "." not in name or name.endswith(LOCAL) or name in own_names
    )


def refusal(host: str) -> str:
    """What a caller is told that has named a host of a stranger."""
    return (
        f"rosproxy: {brief(host, LONGEST_SHOWN)}: the admin endpoint does not answer by this name. "
        "Ask by an IP address, as localhost, by a name without a dot, by the proxy's "
        "--advertise-host, or with 'Authorization: Bearer TOKEN' (--admin-token)\n"
    )
