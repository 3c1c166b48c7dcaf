"""A proxy in more networks than a socket can hear, which come and go."""

import json
import subprocess
import sys

from tests.ros2.many_networks import AT_ONCE, IN_ALL


def test_networks_that_come_and_go_are_heard() -> None:
    """A socket has 20 memberships, and keeps memberships of networks that are gone."""
    run = subprocess.run(
        ["unshare", "--net", sys.executable, "-m", "tests.ros2.many_networks"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)
    assert told["joined"] == [AT_ONCE] + [1] * (IN_ALL - AT_ONCE)
    assert told["heard"] == [AT_ONCE, AT_ONCE, 1]
    assert told["twice"] == [0, 0, 0]
    assert told["sockets"] == [2, 2]
