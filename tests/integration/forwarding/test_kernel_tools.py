"""Requirements of the kernel plane: conditions in files and firewalls, and programs."""

import asyncio
import re
import shutil
import stat
from pathlib import Path

import pytest

from rosproxy.forwarding.kernel import preflight
from rosproxy.forwarding.kernel import tools as kernel_tools
from rosproxy.forwarding.kernel.decisions import HostForwarding
from rosproxy.forwarding.kernel.tools import ToolError, Tools
from rosproxy.shared import fixes
from tests.integration.kernel_fake import FakeTools
from tests.integration.net import until


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A container's view of /proc and /sys."""
    for name, text in (("ipv4", "1\n"), ("ipv6", "0\n"), ("tables", "")):
        (tmp_path / name).write_text(text)
    for interface, mtu in (("eth0", 1500), ("eth1", 1400), ("lo", 65_536)):
        (tmp_path / "net" / interface).mkdir(parents=True)
        (tmp_path / "net" / interface / "mtu").write_text(f"{mtu}\n")
    for attribute, name in (
        ("_IPV4_FORWARDING", "ipv4"),
        ("_IPV6_FORWARDING", "ipv6"),
        ("_LEGACY_TABLES", "tables"),
        ("_INTERFACES", "net"),
    ):
        monkeypatch.setattr(preflight, attribute, tmp_path / name)
    return tmp_path


class ChainTools(FakeTools):
    """Lists chains only."""

    chains = '{"nftables": []}'

    async def nft(self, *words: str, document: str = "") -> str:
        """The chains."""
        assert words == ("-j", "list", "chains")
        return self.chains


async def test_a_sound_container_has_nothing_in_the_way(place: Path) -> None:
    for mode in ("auto", "kernel"):
        assert await preflight.find_obstacle(mode, ChainTools()) is None
    assert preflight.read_forwarding() == HostForwarding(True, False, longest_packet=1500)


async def test_a_host_is_left_alone_unless_asked_for(place: Path) -> None:
    (place / "net" / "eth0" / "device").mkdir()
    said = await preflight.find_obstacle("auto", ChainTools())
    assert said is not None
    assert "eth0" in said
    assert "--data-plane kernel" in said
    assert await preflight.find_obstacle("kernel", ChainTools()) is None


async def test_a_fix_in_a_cluster_names_the_field(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An option of the proxy is of no use there: the operator starts the proxy."""
    monkeypatch.setattr(fixes, "_speaks_for", [fixes.Operator.KUBERNETES])
    (place / "ipv4").write_text("0")
    said = [await preflight.find_obstacle("auto", ChainTools()) or ""]
    (place / "net" / "eth0" / "device").mkdir()
    said.append(await preflight.find_obstacle("auto", ChainTools()) or "")
    assert "run sysctl -w net.ipv4.ip_forward=1 on the node" in said[0]
    assert "set spec.dataPlane: Kernel" in said[1]
    assert not re.search(r"--data-plane|cap_add|sysctls:", " ".join(said))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [("ipv4", "0", "net.ipv4.ip_forward"), ("tables", "nat\nfilter\n", "iptables-legacy")],
)
async def test_what_is_in_the_way(place: Path, name: str, text: str, said: str) -> None:
    (place / name).write_text(text)
    assert said in (await preflight.find_obstacle("kernel", ChainTools()) or "")


async def test_a_file_that_is_not_there_is_not_in_the_way(place: Path) -> None:
    (place / "tables").unlink()
    shutil.rmtree(place / "net")
    assert await preflight.find_obstacle("auto", ChainTools()) is None
    assert preflight.read_forwarding().longest_packet == 0


async def test_a_firewall_that_drops_is_in_the_way(place: Path) -> None:
    tools = ChainTools()
    tools.chains = (
        '{"nftables": [{"chain": {"family": "ip", "table": "filter", "name": "FORWARD", '
        '"hook": "forward", "policy": "drop"}}]}'
    )
    assert "ip filter FORWARD" in (await preflight.find_obstacle("kernel", tools) or "")
    tools.chains = "what?"
    assert "nft printed" in (await preflight.find_obstacle("kernel", tools) or "")


def program(folder: Path, name: str, script: str, mode: int = 0o755) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{script}\n")
    (folder / name).chmod(mode)


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for fake programs, first in the search path."""
    monkeypatch.setattr(kernel_tools, "IMAGE_FOLDER", tmp_path)
    return tmp_path


async def test_programs_get_their_words_and_document(programs: Path) -> None:
    program(programs, "nft", 'echo "$@"; /bin/cat')
    program(programs, "conntrack", 'echo "$@"')
    assert await Tools().nft("-f", "-", document="{}") == "-f -\n{}"
    listed: list[str] = []
    await Tools().list_flows(listed.append, True, "--mark", "1/2")
    assert listed == ["-L -f ipv6 -p tcp --mark 1/2\n"]
    await Tools().forget_flows(False, "--state", "SYN_SENT")


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo cache initialization failed: Operation not permitted >&2; exit 1", "NET_ADMIN"),
        ("echo sorry, you must be root >&2; exit 1", "no-new-privileges"),
        ("echo Error: syntax >&2; exit 1", "Error: syntax"),
    ],
)
async def test_complaints_say_what_to_do(programs: Path, script: str, said: str) -> None:
    program(programs, "nft", script)
    with pytest.raises(ToolError, match=said):
        await Tools().nft("list", "chains")


async def test_a_long_list_keeps_the_loop_for_one_piece_at_a_time(programs: Path) -> None:
    count = 65_000
    program(programs, "conntrack", f"/usr/bin/seq -f 'line %08g of a flood of connections' {count}")
    pieces: list[str] = []
    turns_before: list[int] = []
    turns = 0

    async def turn() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0)
            turns += 1

    def take(lines: str) -> None:
        pieces.append(lines)
        turns_before.append(turns)

    others = asyncio.ensure_future(turn())
    await Tools().list_flows(take, False)
    others.cancel()
    text = "".join(pieces)
    assert text.splitlines()[-1] == f"line {count:08} of a flood of connections"
    assert text.count("\n") == count
    assert max(map(len, pieces)) < kernel_tools.PIECE_BYTES + 100
    assert all(piece.endswith("\n") for piece in pieces)
    assert len(set(turns_before)) == len(turns_before), "other tasks have a turn between two pieces"


async def test_a_list_without_end_is_read_in_part(
    programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_tools, "LONGEST_LIST_BYTES", 100_000)
    program(programs, "conntrack", "exec /usr/bin/yes connection")
    pieces: list[str] = []
    await Tools().list_flows(pieces.append, False)
    assert 50_000 < sum(map(len, pieces)) <= 100_000


async def test_a_list_that_fails_says_what_to_do(
    programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program(programs, "conntrack", "echo Operation not permitted >&2; exit 1")
    with pytest.raises(ToolError, match="NET_ADMIN"):
        await Tools().list_flows(print, False)
    (programs / "conntrack").write_text("#!/no/such/shell\n")
    with pytest.raises(ToolError, match="can't run"):
        await Tools().list_flows(print, False)
    monkeypatch.setattr(kernel_tools, "RUN_TIMEOUT_S", 0.2)
    program(programs, "conntrack", "exec /bin/sleep 30")
    with pytest.raises(ToolError, match="did not end"):
        await Tools().list_flows(print, False)


async def test_deleting_nothing_is_no_failure(programs: Path) -> None:
    program(programs, "conntrack", "echo 0 flow entries have been deleted. >&2; exit 1")
    await Tools().forget_flows(False)
    program(programs, "conntrack", "echo something else >&2; exit 1")
    with pytest.raises(ToolError, match="something else"):
        await Tools().forget_flows(False)


async def test_a_program_that_hangs_is_ended(
    programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_tools, "RUN_TIMEOUT_S", 0.2)
    program(programs, "nft", "exec /bin/sleep 30")
    with pytest.raises(ToolError, match="did not end"):
        await Tools().nft("list", "chains")


async def test_what_a_cancelled_task_began_is_finished(programs: Path) -> None:
    program(
        programs,
        "nft",
        f"echo >{programs}/begun; /bin/sleep 0.3; echo done >{programs}/said; exit 1",
    )
    tools = Tools()
    task = asyncio.ensure_future(tools.nft("list", "chains"))
    await until((programs / "begun").exists, "it begins")
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await tools.settled()
    assert (programs / "said").read_text() == "done\n"


async def test_a_program_that_is_missing_or_broken_is_told(
    programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_tools, "SYSTEM_FOLDERS", ())
    monkeypatch.setenv("PATH", str(programs))
    with pytest.raises(ToolError, match="install nftables"):
        await Tools().nft("list", "chains")
    (programs / "nft").write_text("#!/no/such/shell\n")
    (programs / "nft").chmod(stat.S_IRWXU)
    with pytest.raises(ToolError, match="can't run"):
        await Tools().nft("list", "chains")
