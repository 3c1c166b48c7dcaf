"""Label selectors, read.

The API server is asked for pods with them and refuses what is not well-formed, so this is as strict
as it is (k8s.io/apimachinery, pkg/labels/selector.go and pkg/util/validation/validation.go).
"""

from rosproxy_operator.kubernetes.planner.model import Selector
from rosproxy_operator.kubernetes.planner.values import Field, is_label_key, is_label_value

OPERATORS = ("In", "NotIn", "Exists", "DoesNotExist")
_WITH_VALUES = ("In", "NotIn")


def selector(field: Field) -> Selector | None:
    """A ``metav1.LabelSelector``; None if the field is not given. Raises Unusable."""
    if not field.given:
        return None
    matching = field.child("matchLabels")
    for key, value in matching.texts().items():
        _key(matching, key)
        _value(matching.child(key), value)
    return Selector(
        labels=matching.texts(),
        expressions=tuple(map(_expression, field.child("matchExpressions").list())),
    )


def _expression(field: Field) -> tuple[str, str, frozenset[str]]:
    key, operator = field.child("key").text(), field.child("operator").choice(OPERATORS, "")
    _key(field.child("key"), key)
    values = field.child("values")
    texts = [one.text() for one in values.list()]
    for one, text in zip(values.list(), texts, strict=True):
        _value(one, text)
    if operator in _WITH_VALUES and not texts:
        raise values.wrong(f"is empty, but the operator is {operator}", "name at least one value")
    if operator not in _WITH_VALUES and texts:
        raise values.wrong(f"is not empty, but the operator is {operator}", "leave the values out")
    return key, operator, frozenset(texts)


def _key(field: Field, key: str) -> None:
    if not is_label_key(key):
        raise Field(field.path, key).wrong("is no label's key", "write it as in the pod's labels")


def _value(field: Field, value: str) -> None:
    if not is_label_value(value):
        raise field.wrong("is no label's value", "write it as in the pod's labels")
