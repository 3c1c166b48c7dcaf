"""The links to other sites in a running proxy: the files, and the router's configuration.

The proxy checks the files each second, also by way of symlinks, as in a mounted Secret. Changed
files are used if all fit together. Otherwise the files that were read before stay in use, and the
status has the fault until the files are correct.
"""

import contextlib
import logging
import time
from collections.abc import Iterator

from rosproxy.shared.documents.status_document import ZenohCertificateStatus
from rosproxy.shared.setting_kinds import SettingError
from rosproxy.shared.settings import Settings
from rosproxy.shared.zenoh_rules.key_expressions import check_limits
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy.zenoh.link_files import (
    CERTIFICATE,
    LinkFiles,
    UnusableFile,
    paths_of,
    read_link_files,
    signatures,
)
from rosproxy.zenoh.link_router import LinkPlan
from rosproxy.zenoh.router_configs import RouterConfig

log = logging.getLogger(__name__)

CHECK_INTERVAL_S = 1.0
"""Time between two checks whether a file has changed, in seconds."""
STAY = "The files that were read before stay in use"
NO_LINKS = "Until the file is right, the proxy has no links to other sites"


class SiteLinks:
    """The plan of the links, and the files of the last read without a fault.

    ``files`` is None without links to other sites, and before all files could be used.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._plan = LinkPlan(
            settings.bind,
            settings.zenoh_link,
            settings.zenoh_link_listen,
            settings.zenoh_limit,
            settings.link_policy,
        )
        self.files: LinkFiles | None = None
        self._signatures: list[object] = []
        self._fault: UnusableFile | None = None
        self._is_fault_old = False

    def check(self) -> None:
        """Check limits and rules, and read the files. Raises SettingError.

        With ``--zenoh-await-files``, a file that can't be used is a fault for the status instead.
        """
        if not self._settings.has_site_links:
            return
        with _setting_error("--zenoh-limit"):
            check_limits(self._settings.zenoh_limit)
        with _setting_error("--zenoh-link-policy"):
            check_layers(self._settings.link_policy)
        try:
            self._read()
        except UnusableFile as error:
            if not self._settings.zenoh_await_files:
                raise SettingError(error.option, str(error)) from None
            self._fault = error
            self._is_fault_old = True

    def config(self, hub_socket: str) -> RouterConfig | None:
        """The configuration of the router with the links; None without links."""
        if not self._settings.has_site_links:
            return None
        return self._plan.config(self.files.credentials if self.files else None, hub_socket)

    def look(self) -> bool:
        """Read the files again after a change. Return whether the contents differ.

        A fault counts if the next look finds the fault, too: another program may be about to write
        the files, one after the other. Later looks wait for a change, because OpenSSL may need a
        second for a file with thousands of certificates.
        """
        before = self.files
        is_settled = self._fault is None or self._is_fault_old
        try:
            if is_settled and signatures(paths_of(self._settings)) == self._signatures:
                return False
        except OSError:
            pass  # the read below has the same error, with the name of the file
        try:
            self._read()
        except UnusableFile as error:
            self._is_fault_old = str(error) == str(self._fault)
            self._fault = error
            return False
        self._fault = None
        is_changed = before is None or self.files is None or before[:1] != self.files[:1]
        if is_changed:
            log.info("links to other sites: %s and its files were read again", CERTIFICATE)
        return is_changed

    def certificates(self) -> tuple[ZenohCertificateStatus, ...]:
        """The state of each certificate, for the status."""
        lifetimes = self.files.lifetimes if self.files else {}
        now = time.time()
        faults = {}
        if self._fault and self._is_fault_old:
            faults[self._fault.path] = f"{self._fault.text}. {STAY if self.files else NO_LINKS}"
        rows = []
        for path in dict.fromkeys([*lifetimes, *faults]):
            life = lifetimes.get(path)
            rows.append(
                ZenohCertificateStatus(
                    file=path,
                    error=faults.get(path, ""),
                    starts_in=max(life.begin - now, 0.0) if life else 0.0,
                    ends_in=life.end - now if life else None,
                )
            )
        return tuple(rows)

    def _read(self) -> None:
        """Read the files. Raises UnusableFile."""
        try:
            # Before the read: if a file changes during the read, the next look reads again.
            self._signatures = signatures(paths_of(self._settings))
        except OSError:
            self._signatures = []  # the read has the same error, with the name of the file
        self.files = read_link_files(self._settings)


@contextlib.contextmanager
def _setting_error(option: str) -> Iterator[None]:
    """A context that raises SettingError, which names ``option``, in place of ValueError."""
    try:
        yield
    except ValueError as error:
        raise SettingError(option, str(error)) from None
