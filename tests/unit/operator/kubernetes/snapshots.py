"""The store and the snapshot of a cluster after all watches have delivered."""

from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.records import READERS, key_of
from rosproxy_operator.kubernetes.watch.store import ClusterStore
from tests.unit.operator.kubernetes.api_server import ApiServer


def snapshot_of(server: ApiServer, key: bytes = b"") -> ClusterSnapshot:
    return store_of(server).snapshot(key)


def store_of(server: ApiServer) -> ClusterStore:
    store = ClusterStore([(kind, "") for kind in READERS], ("",), _nothing, _nothing)
    for kind, read in READERS.items():
        records = {key_of(obj): read(obj) for obj in server.all(kind)}
        store.listed(kind, "", {uid: r for uid, r in records.items() if r is not None})
    return store


def _nothing() -> None:
    return None
