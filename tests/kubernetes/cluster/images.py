"""Container images: built by Docker from this tree, and given to the nodes."""

import hashlib
import json
import tarfile
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.docker.engine import ROOT, build, docker, run
from tests.kubernetes.cluster.layout import BIN, NODES, Node
from tests.kubernetes.cluster.node import PAUSE_IMAGE

PROXY_IMAGE, OPERATOR_IMAGE = "rosproxy:test", "rosproxy-operator:test"
ROS_IMAGE = "rosproxy-test-ros:latest"
IMAGES = (PROXY_IMAGE, OPERATOR_IMAGE, ROS_IMAGE)


def build_image(image: str) -> None:
    """Build one of the images as the Docker tests do; Docker knows what has not changed."""
    base = ("--build-arg", f"BASE_IMAGE={_base_image()}")
    if image == ROS_IMAGE:
        build(
            image, *base, "--file", ROOT / "tests/docker/ros.Dockerfile", ROOT / "tests/ros/nodes"
        )
    else:
        target = "proxy" if image == PROXY_IMAGE else "operator"
        build(image, *base, "--target", target, ROOT)


def load_images(*images: str) -> dict[str, list[str]]:
    """Give images to all nodes that do not have them; return which were given to whom."""
    _make_pause_image()
    ids = {image: _id(image) for image in images}
    missing = {node: [name for name in images if _loaded(node).get(name) != ids[name]]
               for node in NODES}  # fmt: skip
    wanted = sorted({name for names in missing.values() for name in names})
    if not wanted:
        return {}
    with tempfile.TemporaryDirectory() as directory:
        archive = Path(directory) / "images.tar"
        docker("save", "--output", archive, *wanted, seconds=300)
        with ThreadPoolExecutor() as threads:
            list(threads.map(lambda node: _import(node, archive), missing))
    for node in NODES:
        node.images.write_text(json.dumps(_loaded(node) | {name: ids[name] for name in wanted}))
    return {node.name: names for node, names in missing.items() if names}


def _import(node: Node, archive: Path) -> None:
    run("ctr", "-a", node.socket, "-n", "k8s.io", "images", "import", archive, seconds=300)


def _loaded(node: Node) -> dict[str, str]:
    try:
        found: dict[str, str] = json.loads(node.images.read_text())
    except OSError:
        return {}
    return found


def _id(image: str) -> str:
    return docker("image", "inspect", "--format", "{{.Id}}", image)


def _base_image() -> str:
    """The image of the Docker tests: Debian without a registry."""
    script = ROOT / "scripts/base-image.sh"
    name = f"rosproxy-test-base:{hashlib.sha256(script.read_bytes()).hexdigest()[:12]}"
    run(script, name, seconds=600)
    return name


def _make_pause_image() -> None:
    """The image whose only program holds a pod's namespaces."""
    if not docker("images", "--quiet", PAUSE_IMAGE):
        with tempfile.NamedTemporaryFile(suffix=".tar") as archive:
            with tarfile.open(archive.name, "w") as tar:
                tar.add(BIN / "pause", "pause")
            docker("import", "--change", 'ENTRYPOINT ["/pause"]', archive.name, PAUSE_IMAGE)
