"""The rule about the ``Host`` of a request: a stranger's web page may not call through a browser.

The owner of a web page can let the name of the page lead to the admin endpoint (DNS rebinding). For
the browser the endpoint is then the server of the page, so the page may read the replies. Other
headers do not show such a request: a browser sends no ``Origin`` to the same origin, and no
``Sec-Fetch-Site`` over HTTP. But ``Host`` has the name of the page. So a request must name an
address, a name that no stranger can register, or a name of the proxy. A request with the token
comes from a program, so any ``Host`` is allowed.
"""

from collections.abc import Collection

from rosproxy.shared.addresses import is_address, parse_authority
from rosproxy.shared.output.text import brief

LOCAL_SUFFIXES = (".localhost", ".local", ".internal", ".svc")
"""Ends of names that no stranger can register on the Internet. Names of Kubernetes Services end in
``.svc`` or ``.svc.cluster.local``."""
LONGEST_SHOWN = 100
"""Characters of a refused name that the refusal repeats."""


def is_own_host(host: str, own_names: Collection[str] = ()) -> bool:
    """Whether ``Host`` has an address, a name that no stranger can register, or an own name.

    ``own_names`` are the names of the proxy, in lower case. True for an empty ``Host``: browsers
    always send ``Host``, so the request comes from a program.
    """
    host_port = parse_authority(f"//{host}")
    name = (host_port.host if host_port else host.partition(":")[0]).lower().rstrip(".")
    return (
        is_address(name.strip("[]"))
        or "." not in name
        or name.endswith(LOCAL_SUFFIXES)
        or name in own_names
    )


def refusal(host: str) -> str:
    """The text of the reply to a request with another ``Host``."""
    return (
        f"rosproxy: {brief(host, LONGEST_SHOWN)}: the admin endpoint does not answer by this name. "
        "Ask by an IP address, as localhost, by a name without a dot, by the proxy's "
        "--advertise-host, or with 'Authorization: Bearer TOKEN' (--admin-token)\n"
    )
