"""Reads the files of links to other sites: certificate, key and CAs."""

import os
import ssl
from collections.abc import Mapping
from typing import NamedTuple

from rosproxy.access.policy_file import file_signature
from rosproxy.shared.setting_kinds import Credentials
from rosproxy.shared.settings import Settings
from rosproxy.zenoh.certificates import (
    CLIENTS,
    SERVERS,
    Lifetime,
    Part,
    Unusable,
    check_credentials,
)

LONGEST_FILE_BYTES = 1024 * 1024
"""Largest file that the proxy reads, in bytes."""
CERTIFICATE = "--zenoh-certificate"
KEY = "--zenoh-key"
CA = "--zenoh-ca"
_OPTIONS: dict[Part, str] = {"certificate": CERTIFICATE, "key": KEY, "CA": CA}


class UnusableFile(ValueError):
    """A file can't be used. The text says why. ``option`` names the file."""

    def __init__(self, option: str, path: str, text: str) -> None:
        super().__init__(f"{path} {text}")
        self.option = option
        self.path = path
        self.text = text


class LinkFiles(NamedTuple):
    """The contents of the files, and the lifetimes of the certificates by path.

    ``client`` makes connections as zenoh makes them, to find out why a link is down.
    """

    credentials: Credentials
    lifetimes: Mapping[str, Lifetime]
    client: ssl.SSLContext


def paths_of(settings: Settings) -> dict[str, str]:
    """The path of each file, by option."""
    return {
        CERTIFICATE: settings.zenoh_certificate,
        KEY: settings.zenoh_key,
        CA: settings.zenoh_ca,
    }


def signatures(paths: Mapping[str, str]) -> list[object]:
    """Values that differ if a file has changed. Raises OSError."""
    return [file_signature(os.stat(path)) for path in paths.values()]


def read_link_files(settings: Settings) -> LinkFiles:
    """Read and check the files. Raises UnusableFile."""
    paths = paths_of(settings)
    contents = {option: _read(option, path) for option, path in paths.items()}
    credentials = Credentials(contents[CERTIFICATE], contents[KEY], contents[CA])
    roles = {CLIENTS: bool(settings.zenoh_link), SERVERS: bool(settings.zenoh_link_listen)}
    try:
        checked = check_credentials(credentials, [role for role, used in roles.items() if used])
    except Unusable as error:
        option = _OPTIONS[error.part]
        raise UnusableFile(option, paths[option], error.text) from None
    lifetimes = {paths[CERTIFICATE]: checked.certificate, paths[CA]: checked.ca}
    return LinkFiles(credentials, lifetimes, checked.client)


def _read(option: str, path: str) -> bytes:
    try:
        with open(path, "rb") as file:
            content = file.read(LONGEST_FILE_BYTES + 1)
    except PermissionError:
        user = f"user {os.getuid()}, as which the proxy runs"
        raise UnusableFile(option, path, f"can't be read: let {user}, read it") from None
    except OSError as error:
        raise UnusableFile(option, path, f"can't be read: {error.strerror}") from None
    if len(content) > LONGEST_FILE_BYTES:
        raise UnusableFile(option, path, f"is longer than {LONGEST_FILE_BYTES} bytes")
    return content
