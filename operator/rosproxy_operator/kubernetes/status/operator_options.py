"""Reads the options of an operator from the operator's pod: arguments and variables.

The doctor does not see options in a file (``--config``), or in a ConfigMap (envFrom).
"""

from collections.abc import Iterator, Sequence

from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json


def option_values(operator: Json, option: str) -> list[str]:
    """Return the values of an option in the pod of an operator; empty if the pod gives none.

    Arguments override the variable, as in the operator. The empty text is a value that the doctor
    does not know: one of valueFrom, or one with $(VARIABLE).
    """
    found: list[str] = []
    for container in submaps(submap(operator, "spec"), "containers"):
        words = [str(word) for key in ("command", "args") for word in container.get(key) or ()]
        given = [*_in_words(words, option)]
        found += given or _in_variables(submaps(container, "env"), option)
    return ["" if "$(" in value else value for value in found]


def _in_words(words: Sequence[str], option: str) -> Iterator[str]:
    """The values of ``OPTION VALUE`` and of ``OPTION=VALUE``."""
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word == option:
            yield following
        elif word.startswith(f"{option}="):
            yield word.partition("=")[2]


def _in_variables(variables: Sequence[Json], option: str) -> list[str]:
    """The values of the option's variable, which blanks separate. An empty variable is unset."""
    name = f"ROSPROXY_{option.removeprefix('--').replace('-', '_').upper()}"
    last = next((v for v in reversed(variables) if v.get("name") == name), {})
    return [""] if "valueFrom" in last else text_at(last, "value").split()
