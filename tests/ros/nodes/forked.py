"""Starts the nodes of node.py as forks of one process: to import rospy costs more than most tests.

    forked.py <REQUESTS >PIDS

A request is one line of JSON: the node's `argv`, its whole `env`, the file `log` for what it
prints, and the file `ended` for its exit status as subprocess gives it. The answer is a line with
its process's number. The node leads a session of its own.
"""

from __future__ import annotations

import json
import os
import signal
import sys

import node
import rospy.names
from rosgraph.names import get_ros_namespace


def main() -> None:
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # a keeper leaves nothing to be waited for
    for line in sys.stdin:
        request = json.loads(line)
        reader, writer = os.pipe()
        keeper = os.fork()
        if keeper == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            child = os.fork()
            if child == 0:
                become(request, writer)
                return node.main()
            os.close(writer)
            keep(child, request["ended"])
        os.close(writer)
        with os.fdopen(reader) as pid:
            print(pid.read(), flush=True)
    return None


def become(request: dict[str, object], writer: int) -> None:
    """Makes this process what it would be, had it been started with these arguments."""
    os.setsid()
    log = os.open(request["log"], os.O_WRONLY | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(log, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout = os.fdopen(1, "w", buffering=1)
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = ["node.py", *request["argv"]]
    # Both were read when it was imported.
    rospy.names.reload_mappings(sys.argv)
    rospy.names._set_caller_id(f"{get_ros_namespace()}unnamed")
    os.write(writer, str(os.getpid()).encode())
    os.close(writer)


def keep(child: int, ended: str) -> None:
    """Waits for a node's end and tells it."""
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with open(f"{ended}.new", "w") as file:
        file.write(str(code))
    os.rename(f"{ended}.new", ended)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
