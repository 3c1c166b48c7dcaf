"""The NetworkPolicy of a RosProxy's proxies. The tests' cluster does not enforce any."""

from tests.docker.engine import wait_until
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.pods import Namespace
from tests.kubernetes.rosproxies import NOWHERE, RosProxy, rosproxy


def policy(of: RosProxy) -> Json:
    return api.get("networkpolicies", of.namespace, f"rosproxy-{of.name}")


def wait_policy(of: RosProxy) -> Json:
    wait_until(lambda: bool(policy(of).get("spec", {}).get("ingress")), 45, of.tell)
    return policy(of)


def test_the_policy_is_made_mended_and_gone_with_its_rosproxy(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    spec = wait_policy(made)["spec"]
    everybody, pods, operator = spec["ingress"]
    assert [port["port"] for port in everybody["ports"]] == [11412]
    assert "from" not in everybody
    assert (pods["ports"][0]["port"], len(pods["from"])) == (11311, 1)
    assert (operator["ports"][0]["port"], len(operator["from"])) == (11312, 1)

    api.patch("networkpolicies", net.name, "rosproxy-robot", {"spec": {"ingress": []}})
    assert wait_policy(made)["spec"] == spec
    mended = policy(made)["metadata"]["generation"]
    net.idle(on="node1")
    made.wait_status(lambda s: s.get("nodes") == 1, "another look")
    assert policy(made)["metadata"]["generation"] == mended  # no further change

    made.remove()
    wait_until(lambda: not policy(made), 45, "the policy is gone")
