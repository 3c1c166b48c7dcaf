"""Where the API server is, and who this process is to it."""

import os
from typing import Any

from kubernetes.client import Configuration
from kubernetes.config import ConfigException, load_incluster_config, load_kube_config

CONNECTIONS = 16
"""Connections to the API server that are kept."""


class NoCluster(Exception):
    """No cluster is configured; the message has the fix."""


def configuration() -> Any:
    """How to reach the API server. Raises NoCluster."""
    settings = Configuration()
    try:
        if os.environ.get("KUBERNETES_SERVICE_HOST"):
            load_incluster_config(client_configuration=settings)  # type: ignore[no-untyped-call]
        else:
            load_kube_config(client_configuration=settings)  # type: ignore[no-untyped-call]
    except (ConfigException, OSError) as error:
        raise NoCluster(
            f"no Kubernetes cluster is configured ({error}). Run this program in a pod with a "
            "service account, or name a kubeconfig file in KUBECONFIG"
        ) from error
    # Callers try again themselves, and are to know of an error at once.
    settings.retries = False
    settings.connection_pool_maxsize = CONNECTIONS
    return settings
