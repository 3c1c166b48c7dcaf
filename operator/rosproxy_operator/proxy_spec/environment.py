"""The variables of a proxy: the settings of ``rosproxy run`` that the operator gives the proxy."""

from collections.abc import Collection, Mapping
from typing import Any

from rosproxy import fixes
from rosproxy.setting_kinds import declared
from rosproxy.settings import Settings

_SETTINGS = {setting.field: setting for setting in declared(Settings)}


def variable(field: str) -> str:
    """The variable for a field of the proxy's `Settings`."""
    # With another variable of the setting, the fingerprint would change, and the operator would
    # recreate the proxies of former operators.
    return "ROS_MASTER_URI" if field == "master_uri" else _SETTINGS[field].variables[0]


def environment(operator: str, told: Mapping[str, Any], always: Collection[str]) -> dict[str, str]:
    """The variables of a proxy for values of fields of the proxy's `Settings`, in the given order.

    Empty values and the proxy's defaults have no variable, except defaults of the fields in
    ``always``. A change of variables or order changes the fingerprint, and recreates proxies.
    """
    variables = {fixes.VARIABLE: operator}
    for field, value in told.items():
        text = _text(value)
        if text and (field in always or value != _SETTINGS[field].default):
            variables[variable(field)] = text
    return variables


def _text(value: Any) -> str:
    """A value as the text of a variable; empty for False, None and empty values."""
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    if isinstance(value, bool | None):
        return "1" if value else ""
    return f"{value:g}" if isinstance(value, float) else str(value)
