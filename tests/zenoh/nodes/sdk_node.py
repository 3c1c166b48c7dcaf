"""A node of zenoh-ros2-sdk, which implements keys, tokens and payloads of rmw_zenoh on its own.

`python sdk_node.py NAME OWNERS` offers a topic and a service below NAME. It also uses the topic and
the service of each of OWNERS, which are nodes (`matrix.py`). Prints what has arrived as `matrix.py`
does, and runs until killed. The library has a node for each entity. Without latched topics: the
library looks for their publishers only at names without a second slash (`_discover_publishers`).
"""

import itertools
import signal
import sys
import threading
import time
from typing import Any

from matrix import ENOUGH_MESSAGES, PERIOD_S, say
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber

# With definitions, the library downloads none.
STRING = {"msg_type": "std_msgs/msg/String", "msg_definition": "string data\n"}
ADD = {
    "srv_type": "example_interfaces/srv/AddTwoInts",
    "request_definition": "int64 a\nint64 b\n",
    "response_definition": "int64 sum\n",
}
CALL_TIMEOUT_S = 5.0
"""If no service is known, a call waits as long."""


def main(name: str, owners: str) -> None:
    # The library's threads may hold up the end of Python.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    publisher = ROS2Publisher(f"/{name}/chatter", node_name=f"{name}_talker", **STRING)
    server: ROS2ServiceServer

    def add(request: Any) -> Any:
        return server.response_msg_class(sum=request.a + request.b)

    server = ROS2ServiceServer(f"/{name}/add", callback=add, node_name=f"{name}_server", **ADD)
    held = [subscribe(name, owner) for owner in owners.split(",")]
    for owner in owners.split(","):
        threading.Thread(target=call, args=(name, owner), daemon=True).start()
    while held:
        publisher.publish(data="hello")
        time.sleep(PERIOD_S)


def subscribe(name: str, owner: str) -> ROS2Subscriber:
    """Subscribe to the topic of a node."""
    numbers = itertools.count(1)

    def take(message: Any) -> None:
        assert message.data == "hello"
        if next(numbers) == ENOUGH_MESSAGES:
            say("got", owner, "topic")

    return ROS2Subscriber(
        f"/{owner}/chatter", callback=take, node_name=f"{name}_listener", **STRING
    )


def call(name: str, owner: str) -> None:
    """Call the service of a node until there is an answer. Keep the client."""
    client = ROS2ServiceClient(
        f"/{owner}/add", node_name=f"{name}_client", timeout=CALL_TIMEOUT_S, **ADD
    )
    while (answer := client.call(a=1, b=2)) is None:
        pass
    say("got", owner, "sum", answer.sum)
    threading.Event().wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
