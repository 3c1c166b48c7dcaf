"""A Kubernetes cluster of two nodes and a robot outside, on this machine.

python -m tests.kubernetes.cluster up, down, …; --help lists the commands.
"""

import os
import sys
import time

import click

from tests.docker.images import build_image
from tests.kubernetes.cluster import layout, lifetime
from tests.kubernetes.cluster.control_plane import restart_api_server
from tests.kubernetes.cluster.images import IMAGES, load_images
from tests.kubernetes.cluster.layout import NODES, node_named
from tests.kubernetes.cluster.node import stop_node
from tests.kubernetes.cluster.robot import exec_on_robot

_NODE = click.argument("node", type=click.Choice([node.name for node in NODES]))
_PASSED_ON = {"ignore_unknown_options": True, "help_option_names": []}


@click.group()
def cluster() -> None:
    """A Kubernetes cluster of two nodes and a robot outside. Needs root."""


@cluster.command()
def up() -> None:
    """Bring the cluster up. Running parts stay."""
    started = time.monotonic()
    lifetime.up()
    click.echo(f"up in {time.monotonic() - started:.0f} s: export KUBECONFIG={layout.KUBECONFIG}")


@cluster.command()
def down() -> None:
    """Remove the whole cluster."""
    lifetime.down()


@cluster.command()
def kubeconfig() -> None:
    """Print the administrator's kubeconfig file."""
    click.echo(layout.KUBECONFIG)


@cluster.command("load-image")
@click.argument("images", nargs=-1)
def load_image(images: tuple[str, ...]) -> None:
    """Load images of Docker into both nodes; without names, all images of the tests."""
    for node, names in load_images(*(images or IMAGES)).items():
        click.echo(f"{node}: {' '.join(names)}")


@cluster.command("build-image")
@click.argument("images", nargs=-1, type=click.Choice(IMAGES))
def build_images(images: tuple[str, ...]) -> None:
    """Build images from this tree and load them into both nodes; without names, all."""
    for image in images or IMAGES:
        build_image(image)
    load_images(*(images or IMAGES))


@cluster.command("exec-on-robot", context_settings=_PASSED_ON)
@click.argument("command", nargs=-1, type=click.UNPROCESSED)
def robot(command: tuple[str, ...]) -> None:
    """Run a command on the robot."""
    sys.exit(exec_on_robot(command))


@cluster.command(context_settings=_PASSED_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def kubectl(arguments: tuple[str, ...]) -> None:
    """Run kubectl as the administrator."""
    _become("kubectl", arguments)


@cluster.command(context_settings=_PASSED_ON)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def helm(arguments: tuple[str, ...]) -> None:
    """Run helm as the administrator."""
    _become("helm", arguments)


@cluster.command("stop-node")
@_NODE
def stop(node: str) -> None:
    """Pull a node's plug."""
    stop_node(node_named(node))


@cluster.command("start-node")
@_NODE
def start(node: str) -> None:
    """Switch a node on again."""
    lifetime.start_node(node_named(node))


@cluster.command("restart-apiserver")
def restart() -> None:
    """Kill and restart the API server."""
    restart_api_server()


def _become(program: str, arguments: tuple[str, ...]) -> None:
    os.environ["KUBECONFIG"] = str(layout.KUBECONFIG)
    path = layout.BIN / program
    os.execv(path, [program, *arguments])


if __name__ == "__main__":
    cluster(prog_name="python -m tests.kubernetes.cluster")
