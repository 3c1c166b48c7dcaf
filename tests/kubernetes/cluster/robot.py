"""The robot: a machine outside the cluster, on the nodes' network and no other."""

import os
import subprocess

from tests.docker.engine import docker, inspect
from tests.docker.images import ROS
from tests.kubernetes.cluster.layout import ROBOT, ROBOT_ADDRESS
from tests.kubernetes.cluster.network import plug_in_robot, unplug_robot


def start_robot() -> None:
    """Start the robot, unless running with the current image."""
    inspection = inspect(ROBOT, check=False)
    wanted = docker("image", "inspect", "--format", "{{.Id}}", ROS)
    if inspection and inspection["State"]["Running"] and inspection["Image"] == wanted:
        return
    docker("rm", "--force", ROBOT, check=False)
    docker(
        "run", "--detach", "--init", "--network", "none", "--name", ROBOT,
        "--env", f"ROS_MASTER_URI=http://{ROBOT_ADDRESS}:11311", "--env", f"ROS_IP={ROBOT_ADDRESS}",
        ROS, "sleep", "infinity",
    )  # fmt: skip
    plug_in_robot(str(inspect(ROBOT)["State"]["Pid"]))


def stop_robot() -> None:
    docker("rm", "--force", ROBOT, check=False)
    unplug_robot()


def exec_on_robot(command: tuple[str, ...]) -> int:
    """Run a command on the robot, with this terminal. Return the exit code."""
    terminal = ("--interactive", "--tty") if os.isatty(0) and os.isatty(1) else ("--interactive",)
    return subprocess.run(["docker", "exec", *terminal, ROBOT, *command], check=False).returncode
