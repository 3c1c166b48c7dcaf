"""Answers of an engine (20.10, API 1.41), reduced to the keys that the operator reads."""

from typing import Any

ID = "45afed2aea6ce3d99bad93fba16fe6eeb3dd62a96377c03959e599e3c9546199"
APP_ID = "3e41cdd9cd516129c312d4db729cb5b14e8b8ab9c498068fdd08b39e5ec0d5bd"


def end(endpoint: str = "", address: str = "", network: str = "") -> dict[str, Any]:
    return {
        "IPAMConfig": None,
        "Links": None,
        "Aliases": None,
        "NetworkID": network,
        "EndpointID": endpoint,
        "Gateway": "",
        "IPAddress": address,
        "IPPrefixLen": 16 if address else 0,
    }


def running() -> dict[str, Any]:
    """A row of ``GET /containers/json``: docker run -p 18080:80 -p 18000-18002:81."""
    ports = [
        {"IP": "0.0.0.0", "PrivatePort": 80, "PublicPort": 18080, "Type": "tcp"},
        {"IP": "::", "PrivatePort": 80, "PublicPort": 18080, "Type": "tcp"},
        {"IP": "0.0.0.0", "PrivatePort": 53, "PublicPort": 18053, "Type": "udp"},
        {"PrivatePort": 11311, "Type": "tcp"},
    ]
    return {
        "Id": ID,
        "Names": ["/talker"],
        "Ports": ports,
        "Labels": {"rosproxy.enable": "true"},
        "State": "running",
        "Status": "Up Less than a second",
        "HostConfig": {"NetworkMode": "app"},
        "NetworkSettings": {"Networks": {"app": end("24786213aa22", "172.29.0.2", APP_ID)}},
    }


def created() -> dict[str, Any]:
    """The same for docker create without --network."""
    return {
        "Id": "8b47950b1e50e8aba5dabccab93007379d9c60801605989f982c05c1da93606c",
        "Names": ["/listener"],
        "Ports": [],
        "Labels": {},
        "State": "created",
        "Status": "Created",
        "HostConfig": {"NetworkMode": "default"},
        "NetworkSettings": {"Networks": {"default": end()}},
    }


def inspected() -> dict[str, Any]:
    """``GET /containers/ID/json``."""
    bindings = {
        "80/tcp": [{"HostIp": "", "HostPort": "18080"}],
        "81/tcp": [{"HostIp": "", "HostPort": "18000-18002"}],
        "82/tcp": [{"HostIp": "127.0.0.1", "HostPort": ""}],
        "83/tcp": [{"HostIp": "", "HostPort": "0"}],
        "53/udp": [{"HostIp": "", "HostPort": "18053"}],
        "84/tcp": None,
    }
    return {
        "State": {"Status": "running", "StartedAt": "2026-11-21T10:27:24.131326951Z"},
        "Config": {
            "Hostname": "bhost",
            "Env": ["ROS_MASTER_URI=http://robot:11311", "EMPTY=", "ROSPROXY_ADMIN_TOKEN=a=b"],
        },
        "HostConfig": {"PortBindings": bindings},
        "NetworkSettings": {
            "Networks": {"app": {"Aliases": ["web", "45afed2aea6c", "bhost"]}},
        },
    }


def network() -> dict[str, Any]:
    """A row of ``GET /networks``."""
    config = [
        {"Subnet": "fd00::/64", "Gateway": "fd00::1"},
        {"Subnet": "172.29.0.0/16", "Gateway": "172.29.0.1"},
    ]
    return {
        "Name": "app",
        "Id": APP_ID,
        "Driver": "bridge",
        "IPAM": {"Driver": "default", "Options": {}, "Config": config},
        "Internal": False,
        "Containers": {},
        "Labels": {},
    }
