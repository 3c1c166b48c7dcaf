"""The variables of a proxy: the settings of ``rosproxy run`` that the operator gives the proxy."""

from collections.abc import Collection, Mapping
from typing import Any

from rosproxy.shared import fixes
from rosproxy.shared.setting_kinds import declared
from rosproxy.shared.settings import Settings

_SETTINGS = {setting.field: setting for setting in declared(Settings)}


def variable(field: str) -> str:
    """The variable for a field of the proxy's `Settings`."""
    # Always this one of the setting's variables. Another one would change the fingerprint, and the
    # operator would recreate the proxies that an earlier version of the operator has started.
    return "ROS_MASTER_URI" if field == "master_uri" else _SETTINGS[field].variables[0]


def environment(
    operator: str, values: Mapping[str, Any], always: Collection[str]
) -> dict[str, str]:
    """The variables of a proxy, in the order of ``values``.

    ``operator``: ``docker`` or ``kubernetes``, for the words of fixes. ``values``: by field of the
    proxy's `Settings`. Empty values and the proxy's defaults have no variable, except defaults of
    the fields in ``always``. Other variables, or another order, change the fingerprint, and the
    operator then recreates the proxies.
    """
    variables = {fixes.VARIABLE: operator}
    for field, value in values.items():
        text = _text(value)
        if text and (field in always or value != _SETTINGS[field].default):
            variables[variable(field)] = text
    return variables


def _text(value: Any) -> str:
    """A value as the text of a variable; empty for False, None, an empty text or tuple."""
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    if isinstance(value, bool | None):
        return "1" if value else ""
    return f"{value:g}" if isinstance(value, float) else str(value)
