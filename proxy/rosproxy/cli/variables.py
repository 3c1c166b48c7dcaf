"""Environment variables that are meant for rosproxy, but that no option reads."""

import difflib
import re
from collections.abc import Collection, Mapping

import msgspec

_PREFIX = "ROSPROXY_"
_NEAR = 0.5
_VERY_NEAR = 0.85
"""Similarity (difflib) for a suggestion: _NEAR after the prefix ROSPROXY_, else _VERY_NEAR."""
_SERVICE_LINK = re.compile(r"_SERVICE_(HOST|PORT(_\w+)?)$|_PORT_\d+_(TCP|UDP|SCTP)(_\w+)?$")
"""Variables that Kubernetes and Docker set for a service whose name begins with rosproxy."""


class UnknownVariable(msgspec.Struct, frozen=True):
    """A variable that no option reads. ``suggestion``: a similar known variable, or empty."""

    name: str
    suggestion: str = ""

    @property
    def text(self) -> str:
        """What is wrong, for a message that begins with the name."""
        hint = f"; did you mean {self.suggestion}?" if self.suggestion else ""
        return f"is not a variable of rosproxy and is ignored{hint}"


def unknown(environment: Mapping[str, str], known_names: Collection[str]) -> list[UnknownVariable]:
    """The variables that are not in ``known_names``, but are probably meant for an option.

    Such a variable begins with ROSPROXY_, or is very similar to a known name.
    """
    variables = []
    for name, value in sorted(environment.items()):
        upper = name.upper()
        prefixed = name.upper().startswith(_PREFIX)
        # Kubernetes also sets NAME_PORT=tcp://10.96.0.7:11311 for a Service
        # (pkg/kubelet/envvars/envvars.go, makeLinkVariables). A NAME_PORT without a URL is from the
        # user.
        linked = _SERVICE_LINK.search(upper) or (upper.endswith("_PORT") and "://" in value)
        if name in known_names or linked or not upper.startswith("ROS"):
            continue
        meant = _nearest(upper, known_names)
        if prefixed or meant:
            variables.append(UnknownVariable(name, meant))
    return variables


def _nearest(name: str, known_names: Collection[str]) -> str:
    """The known variable that is most similar to a name; empty if none is similar enough.

    If the name begins with ROSPROXY_, only the parts behind this prefix count.
    """
    if not name.startswith(_PREFIX):
        return next(iter(difflib.get_close_matches(name, known_names, 1, _VERY_NEAR)), "")
    name_by_suffix = {n.removeprefix(_PREFIX): n for n in known_names if n.startswith(_PREFIX)}
    matches = difflib.get_close_matches(name.removeprefix(_PREFIX), name_by_suffix, 1, _NEAR)
    return name_by_suffix[matches[0]] if matches else ""
