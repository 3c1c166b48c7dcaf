"""Container images of the Docker tests, loaded into the nodes."""

import json
import tarfile
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.docker.engine import docker, run
from tests.docker.images import OPERATOR, PROXY, ROS
from tests.kubernetes.cluster.layout import BIN, NODES, Node
from tests.kubernetes.cluster.node import PAUSE_IMAGE

IMAGES = (PROXY, OPERATOR, ROS)


def load_images(*images: str) -> dict[str, list[str]]:
    """Load missing images into all nodes. Return the loaded images by node."""
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
        loaded: dict[str, str] = json.loads(node.images.read_text())
    except OSError:
        return {}
    return loaded


def _id(image: str) -> str:
    return docker("image", "inspect", "--format", "{{.Id}}", image)


def _make_pause_image() -> None:
    """Make the image whose only program holds a pod's namespaces."""
    if not docker("images", "--quiet", PAUSE_IMAGE):
        with tempfile.NamedTemporaryFile(suffix=".tar") as archive:
            with tarfile.open(archive.name, "w") as tar:
                tar.add(BIN / "pause", "pause")
            docker("import", "--change", 'ENTRYPOINT ["/pause"]', archive.name, PAUSE_IMAGE)
