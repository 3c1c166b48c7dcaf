"""A node of the demonstration as a process, which announces itself to the proxy, and prints events.

Without ROS: `python demo_node.py pub|sub ADDRESS PROXY TOPIC`.
"""

import asyncio
import sys

from examples.demo.ros2_acts import Ros2Listener, Ros2Talker
from examples.demo.rtps_messages import unpack_string
from rosproxy.shared.addresses import HostPort


class PrintingListener(Ros2Listener):
    """Prints each received message."""

    def hear(self, payload: bytes) -> None:
        print("got", unpack_string(payload), flush=True)


async def main(kind: str, address: str, proxy: str, topic: str) -> None:
    node = (Ros2Talker if kind == "pub" else PrintingListener)("/inside/node", address, topic)
    await node.start()
    node.announce_to([HostPort(proxy, 7410)])
    if isinstance(node, Ros2Talker):
        await node.talk()
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
