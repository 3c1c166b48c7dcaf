"""Runs ROS's Python programs as forks of a process, because importing rospy is slow.

    forked.py <REQUESTS >PIDS

A request is a line of JSON: `argv` and the whole `env` of the program, the file `log` for the
output, and the file `ended` for the exit status in the form of subprocess. The answer is a line
with the process id. The program leads a separate session.
"""

from __future__ import annotations

import io
import json
import os
import runpy
import signal
import sys

import actionlib  # noqa: F401 - this and further imports are for the forks
import rosnode  # noqa: F401
import rosparam  # noqa: F401
import rospy.names
import rosservice  # noqa: F401
import rostopic  # noqa: F401
import topic_tools.srv  # noqa: F401
from actionlib import msg  # noqa: F401
from rosgraph.names import get_ros_namespace


def main() -> None:
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps the parents of the programs
    for line in sys.stdin:
        request = json.loads(line)
        reader, writer = os.pipe()
        parent = os.fork()
        if parent == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            child = os.fork()
            if child == 0:
                become(request, writer)
                runpy.run_path(sys.argv[0], run_name="__main__")
                return
            os.close(writer)
            keep(child, request["ended"])
        os.close(writer)
        with os.fdopen(reader) as pid:
            print(pid.read(), flush=True)


def become(request: dict[str, object], writer: int) -> None:
    """Make this process equal to a program with the arguments and environment of the request."""
    os.setsid()
    log = os.open(request["log"], os.O_WRONLY | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(log, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", buffering=0), write_through=True)
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv[:] = request["argv"]  # in place: modules have kept the list
    # rospy reads both on import.
    rospy.names.reload_mappings(sys.argv)
    rospy.names._set_caller_id(f"{get_ros_namespace()}unnamed")
    os.write(writer, str(os.getpid()).encode())
    os.close(writer)


def keep(child: int, ended: str) -> None:
    """Wait for the end of a program, write the exit status to a file, and exit."""
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with open(f"{ended}.new", "w") as file:
        file.write(str(code))
    os.rename(f"{ended}.new", ended)
    os._exit(0)


if __name__ == "__main__":
    main()
