"""ROS graph names: how a name given by a node becomes a global one."""

from __future__ import annotations

ANY_TYPE = "*"


def canonical(name: str) -> str:
    """Drop doubled and trailing slashes of a global name."""
    return "/" + "/".join(part for part in name.split("/") if part)


def namespace(caller_id: str) -> str:
    """Return the namespace that the node `caller_id` lives in, with a trailing slash."""
    return caller_id.rstrip("/").rpartition("/")[0] + "/"


def resolve(name: str, caller_id: str) -> str:
    """Resolve `name` as the node `caller_id` means it: global, private (~) or relative."""
    if not name:
        return canonical(namespace(caller_id))
    if name.startswith("/"):
        return canonical(name)
    if name.startswith("~"):
        return canonical(f"{caller_id}/{name[1:]}")
    return canonical(namespace(caller_id) + name)
