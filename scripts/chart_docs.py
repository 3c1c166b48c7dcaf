"""Write the tables of docs/reference/custom-resource.md, which are made from the chart.

    python scripts/chart_docs.py [--check]

Between ``<!-- NAME -->`` and ``<!-- end of NAME -->`` stand the fields of the RosProxy, from the
custom resource definition in manifests/install.yaml, and the chart's values with the comments of
values.yaml. With ``--check`` nothing is written; the exit code tells whether the page is as it
should be.
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/reference/custom-resource.md"
INSTALL = ROOT / "manifests/install.yaml"
VALUES = ROOT / "charts/rosproxy/values.yaml"

_KEY = re.compile(r"( *)([A-Za-z]+):(?: (.*))?")
_HEADING = re.compile(r"# -- .* -+")
_EXAMPLE = re.compile(r" *#  ")


def custom_resource() -> Mapping[str, Any]:
    """The custom resource definition, as it is installed."""
    documents = yaml.safe_load_all(INSTALL.read_text())
    return next(one for one in documents if one["kind"] == "CustomResourceDefinition")


def fields_table(part: str, definition: Mapping[str, Any]) -> str:
    """The fields of the spec or of the status, as a table."""
    schema = definition["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"][part]
    rows = ["| field | type | default | meaning |", "|---|---|---|---|", *_fields(schema, part)]
    return "\n".join(rows)


def _fields(schema: Mapping[str, Any], path: str) -> Iterator[str]:
    required = schema.get("required", [])
    for name, field in schema.get("properties", {}).items():
        where = f"{path}.{name}"
        default = "required" if name in required else _default(field)
        yield f"| `{where}` | {_type(field)} | {default} | {_meaning(field)} |"
        yield from _fields(field, where)
        if _is_list_of_objects(field):
            yield from _fields(field["items"], f"{where}[]")


def _is_list_of_objects(field: Mapping[str, Any]) -> bool:
    return bool(field.get("type") == "array" and field["items"].get("type") == "object")


def _default(field: Mapping[str, Any]) -> str:
    if "default" not in field:
        return ""
    value = field["default"]
    return f"`{value if isinstance(value, str) else json.dumps(value)}`"


def _type(field: Mapping[str, Any]) -> str:
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    kind = str(field["type"])
    if kind == "integer" and "minimum" in field:
        return f"{field['minimum']} to {field['maximum']}"
    if kind == "array":
        return f"list of {_plural(str(field['items']['type']))}"
    if "additionalProperties" in field:
        return "map"
    return kind


def _plural(kind: str) -> str:
    return f"{kind}s"


def _meaning(field: Mapping[str, Any]) -> str:
    text = str(field["description"])
    rules = field.get("x-kubernetes-validations", [])
    refusals = [f"Refused with: *{rule['message']}*." for rule in rules]
    return " ".join([text, *refusals]).replace("|", r"\|")


def values_table(text: str) -> str:
    """The chart's values with their defaults and comments, as a table."""
    rows = ["| value | default | meaning |", "|---|---|---|"]
    rows += [f"| `{path}` | {default} | {meaning} |" for path, default, meaning in values(text)]
    return "\n".join(rows)


def values(text: str) -> Iterator[tuple[str, str, str]]:
    """Each value, and each group with a comment: its path, its default, and the comment above."""
    path: list[str] = []
    comment: list[str] = []
    for line in text.splitlines():
        found = _KEY.fullmatch(line)
        if found:
            path = [*path[: len(found[1]) // 2], found[2]]
            if comment or found[3]:
                yield ".".join(path), _shown(found[3]), " ".join(comment)
            comment = []
        elif not line.strip() or _HEADING.fullmatch(line):
            comment = []
        elif line.strip().startswith("#") and not _EXAMPLE.match(line):
            comment.append(line.strip(" #"))


def _shown(default: str | None) -> str:
    return "" if default in (None, '""') else f"`{default}`"


def page(text: str) -> str:
    """The page with its tables made anew."""
    definition = custom_resource()
    tables = {
        "fields of the spec": fields_table("spec", definition),
        "fields of the status": fields_table("status", definition),
        "values of the chart": values_table(VALUES.read_text()),
    }
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, rest = text.split(begin)
        text = f"{before}{begin}\n{table}\n\n{end}{rest.split(end)[1]}"
    return text


def main() -> int:
    text = PAGE.read_text()
    wanted = page(text)
    if "--check" not in sys.argv:
        PAGE.write_text(wanted)
    return int("--check" in sys.argv and text != wanted)


if __name__ == "__main__":
    sys.exit(main())
