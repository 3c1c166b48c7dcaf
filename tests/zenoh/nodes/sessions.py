"""Sessions with the defaults of rmw_zenoh 0.6, for nodes and for the router.

The values are of DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5 and DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5.
ZENOH_CONFIG_OVERRIDE has the syntax of rmw_zenoh.
"""

import os
import signal
from typing import Any

import zenoh

COMMON = {
    "adminspace/enabled": "true",
    "connect/timeout_ms": '{"router":-1,"peer":-1,"client":0}',
    "connect/exit_on_failure": '{"router":false,"peer":false,"client":true}',
    "scouting/multicast/enabled": "false",
    "scouting/gossip/target": '{"router":["router","peer"],"peer":["router"]}',
    "scouting/gossip/autoconnect": '{"router":[],"peer":["router","peer"]}',
    "timestamping/enabled": "true",
    "transport/link/tx/lease": "60000",
    "transport/link/tx/keep_alive": "2",
    "transport/shared_memory/enabled": "false",
    "transport/unicast/open_timeout": "60000",
}
NODE = {
    "mode": '"peer"',
    "connect/endpoints": '["tcp/localhost:7447"]',
    "listen/endpoints": '["tcp/localhost:0"]',
    "scouting/gossip/autoconnect_strategy": (
        '{"peer":{"to_router":"always","to_peer":"greater-zid"}}'
    ),
}
ROUTER = {
    "mode": '"router"',
    "listen/endpoints": '["tcp/0.0.0.0:7447"]',
    "routing/router/peers_failover_brokering": "false",
}


def open_session(own: dict[str, str]) -> Any:
    """Open a session with these values and the values of ZENOH_CONFIG_OVERRIDE."""
    # The library's threads may hold up the end of Python.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    zenoh.init_log_from_env_or("error")
    config = zenoh.Config()
    for key, value in (COMMON | own).items():
        config.insert_json5(key, value)
    for pair in filter(None, os.environ.get("ZENOH_CONFIG_OVERRIDE", "").split(";")):
        config.insert_json5(*pair.split("=", 1))
    return zenoh.open(config)
