"""The scripts of the chart's `helm test`, as two clients of the proxy."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.ros.processes import Process
from tests.zenoh.lab import ENVIRONMENTS, OWN_VERSION, Lab

FILES = Path(__file__).parents[2] / "charts/rosproxy-operator/files"
OVERRIDE = "ZENOH_CONFIG_OVERRIDE"


@pytest.fixture
def scripts(tmp_path: Path) -> Path:
    """The folder of both scripts, as in the pods."""
    folder = tmp_path / "test"
    folder.mkdir()
    for name in ("echo", "test"):
        (folder / f"{name}.py").write_text((FILES / f"zenoh_{name}.py").read_text())
    return folder


def run(lab: Lab, script: Path, role: str, **environment: str) -> Process:
    """Run a script on a machine, as on a node of the cluster with the name of the machine."""
    python = str(ENVIRONMENTS / OWN_VERSION / "bin/python")
    given = {"NODE_NAME": "test_echo", "ON_NODE": role, "NAMESPACE": "ns", "ROSPROXY": "test"}
    return lab.start(role, [python, str(script)], given | {"TIMEOUT": "60"} | environment)


def client(lab: Lab) -> dict[str, str]:
    """The variable that the webhook sets."""
    return {OVERRIDE: f"{lab.as_client()[OVERRIDE]};connect/timeout_ms=-1"}


def test_the_test_passes(lab: Lab, scripts: Path) -> None:
    test = run(lab, scripts / "test.py", "c1", **client(lab))  # waits for the proxy
    lab.start_proxy(with_robot=False)
    run(lab, scripts / "echo.py", "c2", **client(lab))
    test.wait_for("PASSED: a question went to the pod on node c2", timeout=60)
    assert test.wait() == 0


@pytest.mark.parametrize("is_wired", [True, False])
def test_the_test_fails(lab: Lab, scripts: Path, is_wired: bool) -> None:
    variable = client(lab) if is_wired else {}
    test = run(lab, scripts / "test.py", "c1", **variable, TIMEOUT="1")
    causes = {True: "FAILED: no answer comes", False: "FAILED: this pod was not wired"}
    test.wait_for(causes[is_wired], timeout=60)
    assert test.wait() == 1
