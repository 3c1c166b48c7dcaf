"""An API server on loopback, and the client that leads to it."""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from rosproxy_operator.kubernetes.api.api_client import Api
from tests.unit.operator.kubernetes.api_server import ApiServer, serving


@pytest.fixture
async def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[ApiServer]:
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    # The client reads the path of the configuration on import.
    monkeypatch.setattr(
        "kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", str(tmp_path / "config")
    )
    async with serving(tmp_path) as running:
        yield running


@pytest.fixture
def api(server: ApiServer) -> Iterator[Api]:
    client = Api()
    yield client
    client.close()
