"""Changes of a document: exactly the parts that turn the old document into the new."""

import json
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.page.changes import changes
from tests.page_updates import apply_update

ROWS = st.dictionaries(st.sampled_from("abcd"), st.fixed_dictionaries({"n": st.integers(0, 2)}))
DOCUMENTS = st.fixed_dictionaries({"nodes": ROWS, "links": ROWS, "left_out": st.integers(0, 2)})


@given(DOCUMENTS, DOCUMENTS)
def test_changes_make_the_new_document_of_the_old(
    before: dict[str, Any], after: dict[str, Any]
) -> None:
    update = json.loads(json.dumps(changes(before, after)))
    assert apply_update(before, update) == after
    assert bool(update) == (before != after)


def test_only_what_differs_is_told() -> None:
    before: dict[str, Any] = {"nodes": {"a": {"n": 1}, "b": {"n": 1}}, "links": {}, "left_out": 0}
    after = {"nodes": {"a": {"n": 1}, "c": {"n": 2}}, "links": {}, "left_out": 0}
    assert changes(before, after) == {"nodes": {"b": None, "c": {"n": 2}}}
