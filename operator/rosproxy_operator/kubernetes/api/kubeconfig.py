"""The address of the API server, and the credentials of this process."""

import os
from typing import Any

from kubernetes.client import Configuration
from kubernetes.config import ConfigException, load_incluster_config, load_kube_config

MOST_OPEN_CONNECTIONS = 16
"""Connections to the API server that the client keeps open."""


class NoCluster(Exception):
    """No cluster is configured. The message has the fix."""


def configuration() -> Any:
    """Return the client's configuration: of this pod, or else from the kubeconfig file.

    Raises NoCluster.
    """
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
    # Without urllib3's own retries, an error reaches the caller at once. The caller tries again.
    settings.retries = False
    settings.connection_pool_maxsize = MOST_OPEN_CONNECTIONS
    return settings
