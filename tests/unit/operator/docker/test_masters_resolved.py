"""The addresses of masters."""

import pytest

from rosproxy_operator.common import master_resolver
from rosproxy_operator.common.master_resolver import MasterResolver


class Names:
    """A name server with ``addresses`` for names. ``asked`` are the requested names."""

    def __init__(self) -> None:
        self.addresses: dict[str, list[str]] = {}
        self.asked: list[str] = []

    async def resolve(self, host: str) -> list[str]:
        self.asked.append(host)
        return self.addresses.get(host, [])


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    names = Names()
    monkeypatch.setattr(master_resolver, "resolve", names.resolve)
    monkeypatch.setattr(master_resolver, "RESOLVE_INTERVAL_S", 0.0)
    monkeypatch.setattr(master_resolver, "UNRESOLVED_RETRY_S", 0.0)
    return names


@pytest.fixture
def changes() -> list[int]:
    return []


@pytest.fixture
def masters(changes: list[int]) -> MasterResolver:
    return MasterResolver(lambda: changes.append(1))


async def test_an_address_needs_no_name_server(masters: MasterResolver, names: Names) -> None:
    await masters.learn(["192.0.2.7"], {}, [])
    assert masters.address("192.0.2.7") == "192.0.2.7"
    assert names.asked == []


async def test_a_name_is_asked_for_when_it_is_new(masters: MasterResolver, names: Names) -> None:
    names.addresses["robot"] = ["192.0.2.7"]
    for _ in range(2):
        await masters.learn(["robot"], {}, [])
    assert masters.address("robot") == "192.0.2.7"
    assert names.asked == ["robot"]


async def test_the_last_good_address_is_kept(
    masters: MasterResolver, names: Names, changes: list[int]
) -> None:
    names.addresses["robot"] = ["192.0.2.7"]
    await masters.learn(["robot"], {}, [])
    names.addresses.clear()
    await masters.refresh()
    assert masters.address("robot") == "192.0.2.7"
    assert changes == []


async def test_a_change_is_told(masters: MasterResolver, names: Names, changes: list[int]) -> None:
    names.addresses["robot"] = ["192.0.2.7", "192.0.2.8"]
    await masters.learn(["robot"], {}, [])
    names.addresses["robot"].reverse()  # the address in use is still valid
    await masters.refresh()
    assert (masters.address("robot"), changes) == ("192.0.2.7", [])
    names.addresses["robot"] = ["192.0.2.9"]
    await masters.refresh()
    assert (masters.address("robot"), changes) == ("192.0.2.9", [1])


async def test_neither_loopback_nor_a_proxy_is_a_master(
    masters: MasterResolver, names: Names
) -> None:
    names.addresses["robot"] = ["127.0.1.1", "172.18.0.2", "192.0.2.7"]
    await masters.learn(["robot"], {}, ["172.18.0.2"])
    assert masters.address("robot") == "192.0.2.7"


async def test_what_the_engine_knows_helps_where_no_name_server_does(
    masters: MasterResolver, names: Names
) -> None:
    await masters.learn(["roscore", "robot"], {"roscore": "172.18.0.5"}, [])
    assert masters.address("roscore") == "172.18.0.5"
    assert masters.address("robot") == ""


async def test_names_that_nobody_uses_any_more_are_forgotten(
    masters: MasterResolver, names: Names
) -> None:
    names.addresses["robot"] = ["192.0.2.7"]
    await masters.learn(["robot"], {}, [])
    await masters.learn([], {}, [])
    assert masters.address("robot") == ""
    await masters.refresh()
    assert names.asked == ["robot"]
