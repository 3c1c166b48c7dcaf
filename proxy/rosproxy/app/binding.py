"""Ports and addresses that can't be bound, told by the option that names them."""

import contextlib
import errno
from collections.abc import Collection, Iterator

from rosproxy.settings import SettingError


@contextlib.contextmanager
def setting_error_if_taken(
    option: str, subject: object, holders: Collection[object] = ()
) -> Iterator[None]:
    """While ``subject`` is bound; raises SettingError instead of OSError.

    ``holders`` are those who are likely to have it, if somebody has.
    """
    try:
        yield
    except OSError as error:
        text = f"{subject} can't be bound: {error.strerror}"
        if error.errno == errno.EADDRINUSE:
            text += f" by {'; '.join(map(str, holders))}" if holders else " (ss -ltunp: by whom)"
        raise SettingError(option, text) from None
