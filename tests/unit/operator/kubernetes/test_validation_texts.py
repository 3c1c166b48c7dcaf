"""The texts of the API server that the cluster tests expect stand in the CRD."""

from pathlib import Path

import pytest

from tests.kubernetes.test_validation import BAD

ROOT = Path(__file__).parents[4]
CRD = " ".join((ROOT / "charts/rosproxy-operator/templates/crd.yaml").read_text().split())


@pytest.mark.parametrize("words", sorted({words for _, words in BAD.values() if " " in words}))
def test_the_definition_has_the_text(words: str) -> None:
    """A cluster test takes minutes, and runs only in `make test-all`."""
    assert words in CRD
