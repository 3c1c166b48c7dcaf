"""Every subcommand of rosparam, inside and outside."""

from __future__ import annotations

from pathlib import Path

from tests.ros.combinations import each_side
from tests.ros.lab import Lab

OTHER = {"c1": "out", "out": "c1"}


@each_side
def test_rosparam_set_get_list_and_delete(lab: Lab, side: str) -> None:
    key = f"/{lab.unique('tree')}"
    lab.run(side, "rosparam", "set", f"{key}/gains", "{p: 1.5, i: 2, name: '', flag: true}")
    lab.run(side, "rosparam", "set", f"{key}/text", "two words")
    assert lab.run(OTHER[side], "rosparam", "get", f"{key}/text").output == "two words\n"
    listed = lab.run(OTHER[side], "rosparam", "list", key).output.split()
    assert set(listed) == {
        f"{key}/{leaf}" for leaf in ("gains/p", "gains/i", "gains/name", "gains/flag", "text")
    }
    got = lab.run(OTHER[side], "rosparam", "get", f"{key}/gains").output
    assert sorted(got.split("\n")) == ["", "", "flag: true", "i: 2", "name: ''", "p: 1.5"]
    lab.run(OTHER[side], "rosparam", "delete", key)
    assert lab.run(side, "rosparam", "get", key, check=False).returncode != 0


@each_side
def test_rosparam_dump_and_load(lab: Lab, side: str, tmp_path: Path) -> None:
    key = f"/{lab.unique('origin')}"
    copy = f"/{lab.unique('copy')}"
    value = {"list": [1, 2.5, "x"], "deep": {"flag": False, "empty": ""}}
    lab.ask_master("setParam", key, value, role=OTHER[side])
    lab.run(side, "rosparam", "dump", str(tmp_path / "p.yaml"), key)
    lab.run(side, "rosparam", "load", str(tmp_path / "p.yaml"), copy)
    assert lab.ask_master("getParam", copy) == value
