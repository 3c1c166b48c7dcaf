"""The whole cluster, up and down."""

import shutil
from concurrent.futures import ThreadPoolExecutor

from tests.docker.engine import answers, wait_until
from tests.docker.images import build_image
from tests.kubernetes.cluster import mounts
from tests.kubernetes.cluster.certificates import make_certificates
from tests.kubernetes.cluster.control_plane import (
    kubectl,
    start_control_plane,
    stop_control_plane,
)
from tests.kubernetes.cluster.images import IMAGES, load_images
from tests.kubernetes.cluster.layout import KUBECONFIG, NODES, PKI, STATE, Node
from tests.kubernetes.cluster.network import make_bridge, remove_bridge
from tests.kubernetes.cluster.node import (
    PAUSE_IMAGE,
    join,
    remove_node,
    start_containerd,
    wait_until_ready,
)
from tests.kubernetes.cluster.robot import start_robot, stop_robot


def up() -> None:
    """Bring up all missing parts of the cluster: control plane, nodes, images, robot."""
    assert answers(), "Docker does not answer, and has to build the images and run the robot"
    if STATE.exists() and not (KUBECONFIG.exists() and PKI.exists()):
        down()  # a former `up` or `down` was killed half-way
    STATE.mkdir(parents=True, exist_ok=True)
    make_certificates()
    make_bridge()
    with ThreadPoolExecutor() as threads:
        plane = threads.submit(start_control_plane)
        for node in NODES:
            start_containerd(node)
        images = threads.submit(_images)
        plane.result()
        list(threads.map(join, NODES))
        for node in NODES:
            wait_until_ready(node)
        images.result()
    start_robot()
    wait_until(_takes_pods, 60, "namespace default has a service account")


def down() -> None:
    """Stop the whole cluster and leave nothing behind."""
    KUBECONFIG.unlink(missing_ok=True)  # first: a sign for `up` that the rest is incomplete
    for node in NODES:
        remove_node(node)
    stop_control_plane()
    if answers():
        stop_robot()
    remove_bridge()
    mounts.unmount_below(STATE)
    if STATE.exists():
        shutil.rmtree(STATE)  # without a deadline: a busy disk needs over a minute


def start_node(node: Node) -> None:
    """Switch a node on again."""
    start_containerd(node)
    join(node)
    wait_until_ready(node)


def _images() -> None:
    for image in IMAGES:
        build_image(image)
    load_images(PAUSE_IMAGE, *IMAGES)


def _takes_pods() -> bool:
    account = kubectl("get", "serviceaccount", "default", "--ignore-not-found", "--output=name")
    return account != ""
