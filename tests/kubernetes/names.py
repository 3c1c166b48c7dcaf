"""The cluster's DNS, as far as tests need it: names of pods behind a headless Service.

The names follow the specification of Kubernetes (dns/docs/specification.md, section 2.4): an
endpoint with a host name is at HOSTNAME.SERVICE.NAMESPACE.svc.ZONE.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from tests.docker.name_server import name_server
from tests.kubernetes import api
from tests.kubernetes.cluster.layout import CLUSTER_DOMAIN, GATEWAY

_SERVICE = "kubernetes.io/service-name"
_LABELS = 3
"""HOSTNAME.SERVICE.NAMESPACE"""


class PodNames(Mapping[str, str]):
    """The addresses of pods by name, as the API server has them at the moment."""

    def __getitem__(self, name: str) -> str:
        head, found, _ = name.partition(f".svc.{CLUSTER_DOMAIN}")
        labels = head.split(".")
        if not found or len(labels) != _LABELS:
            raise KeyError(name)
        hostname, service, namespace = labels
        for endpoints in api.objects("endpointslices", namespace, f"{_SERVICE}={service}"):
            for endpoint in endpoints.get("endpoints") or ():
                if endpoint.get("hostname") == hostname:
                    return str(endpoint["addresses"][0])
        raise KeyError(name)

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0


@contextmanager
def cluster_dns() -> Iterator[None]:
    """Answer the pods' questions for names of pods. Other names don't exist."""
    with name_server(GATEWAY, PodNames()):
        yield
