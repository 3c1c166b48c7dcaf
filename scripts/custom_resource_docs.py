"""Write the tables of the RosProxy's fields in docs/reference/custom-resource.md.

    python scripts/custom_resource_docs.py [--check]

Each table stands between two comments, for example ``<!-- fields of the spec -->`` and ``<!-- end
of fields of the spec -->``. The rows come from the custom resource definition in
manifests/install.yaml. If a description has a sentence ``Default is ...``, the sentence goes into
the column of the defaults. With ``--check`` the script writes nothing, and exits with 1 if the
tables of the page are outdated.
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
DEFAULT = re.compile(r"\s*Default(?: is|:) (.+?)\.(?=\s|$)")
"""The sentence of a description that gives the default."""


def custom_resource() -> Mapping[str, Any]:
    """Return the custom resource definition that manifests/install.yaml installs."""
    documents = yaml.safe_load_all(INSTALL.read_text())
    return next(d for d in documents if d["kind"] == "CustomResourceDefinition")


def fields_table(section: str, definition: Mapping[str, Any]) -> str:
    """Return the table of the fields of the spec or of the status."""
    schema = definition["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"][section]
    rows = ["| field | type | default | meaning |", "|---|---|---|---|", *_fields(schema, section)]
    return "\n".join(rows)


def _fields(schema: Mapping[str, Any], path: str) -> Iterator[str]:
    required = schema.get("required", [])
    for name, field in schema.get("properties", {}).items():
        field_path = f"{path}.{name}"
        default = "required" if name in required else _default(field)
        yield f"| `{field_path}` | {_type(field)} | {default} | {_meaning(field)} |"
        yield from _fields(field, field_path)
        if _is_list_of_objects(field):
            yield from _fields(field["items"], f"{field_path}[]")


def _is_list_of_objects(field: Mapping[str, Any]) -> bool:
    return bool(field.get("type") == "array" and field["items"].get("type") == "object")


def _default(field: Mapping[str, Any]) -> str:
    if "default" in field:
        value = field["default"]
        return f"`{value if isinstance(value, str) else json.dumps(value)}`"
    stated = DEFAULT.search(str(field["description"]))
    return stated[1].replace("|", r"\|") if stated else ""


def _type(field: Mapping[str, Any]) -> str:
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    kind = str(field.get("type", "integer or string"))
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
    if "default" not in field:
        text = DEFAULT.sub("", text, count=1)
    rules = field.get("x-kubernetes-validations", [])
    refusals = [f"Refused with: *{rule['message']}*." for rule in rules]
    return " ".join([text, *refusals]).replace("|", r"\|")


def with_new_tables(text: str) -> str:
    """Return the page with new tables."""
    definition = custom_resource()
    tables = {
        "fields of the spec": fields_table("spec", definition),
        "fields of the status": fields_table("status", definition),
    }
    for name, table in tables.items():
        begin = f"<!-- {name} -->\n"
        end = f"<!-- end of {name} -->"
        before, rest = text.split(begin)
        text = f"{before}{begin}\n{table}\n\n{end}{rest.split(end)[1]}"
    return text


def main() -> int:
    text = PAGE.read_text()
    wanted = with_new_tables(text)
    if "--check" not in sys.argv:
        PAGE.write_text(wanted)
    return int("--check" in sys.argv and text != wanted)


if __name__ == "__main__":
    sys.exit(main())
