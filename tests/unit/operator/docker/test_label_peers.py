"""The peers that the labels of all containers of a proxy name."""

from rosproxy_operator.docker.planner.actions import Create
from rosproxy_operator.docker.planner.label_peers import MOST_PEERS_OF_PROXY
from rosproxy_operator.docker.planner.model import Container
from rosproxy_operator.docker.planner.specs import container_config
from rosproxy_operator.docker.planner.state import DockerMemory
from tests.unit.operator.docker.builders import SECRET, SETTINGS, container, observed, planned


def of_domain(name: str, peers: int) -> Container:
    host = "p" * 200
    labels = {
        "rosproxy.enable": "true",
        "rosproxy.ros": "2",
        "rosproxy.peers": ",".join(f"{host}{name}-{n}:11400" for n in range(peers)),
    }
    return container(name, labels)


def test_many_containers_with_peers_keep_no_proxy_from_starting() -> None:
    """Linux starts no program with a variable of 128 KiB."""
    crowd = [of_domain(f"c{n:02}", 32) for n in range(20)]
    plan = planned(observed(*crowd, of_domain("few", 2)), SETTINGS, DockerMemory(), 0.0)
    (made,) = [action for action in plan.actions if isinstance(action, Create)]
    assert len(made.peers) <= MOST_PEERS_OF_PROXY
    assert len([peer for peer in made.peers if "few-" in peer]) == 2
    body = container_config(made, SETTINGS, SECRET, "")
    assert max(len(variable) for variable in body["Env"]) < 128 * 1024
    ignored = {p.subject for p in plan.problems if "label rosproxy.peers is ignored" in p.message}
    assert ignored == {f"container c{n:02}" for n in range(7, 20)}
    assert not any(problem.fatal for problem in plan.problems)
