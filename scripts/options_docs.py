"""Write the table of the proxy's settings in docs/reference/options.md.

    python -m scripts.options_docs

It stands between ``<!-- settings of the proxy -->`` and ``<!-- end of settings of the proxy -->``,
and is made of the annotations of `rosproxy.settings.Settings`.
"""

from collections.abc import Iterator
from pathlib import Path

from rosproxy.settings import Settings
from rosproxy.values import Setting, declared

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/reference/options.md"
BEGIN, END = "<!-- settings of the proxy -->\n", "<!-- end of settings of the proxy -->"


def page(text: str) -> str:
    """The page with its table made anew."""
    before, rest = text.split(BEGIN)
    table = "\n".join(_table())
    return f"{before}{BEGIN}\n{table}\n\n{END}{rest.split(END)[1]}"


def _table() -> Iterator[str]:
    yield from ("| option | variable | default | meaning |", "|---|---|---|---|")
    for setting in declared(Settings):
        cells = (_option(setting), _variables(setting), _default(setting), setting.option.help)
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _option(setting: Setting) -> str:
    kind = setting.option.kind
    form = kind.form if kind else "|".join(setting.words)
    return f"`{setting.name} {form}`" if form else f"`{setting.name}`"


def _variables(setting: Setting) -> str:
    own = f"ROSPROXY_{setting.parameter.upper()}"
    names = ", ".join(f"`{name}`" for name in setting.option.variables or (own,))
    return f"{names} ({setting.option.note})" if setting.option.note else names


def _default(setting: Setting) -> str:
    default = setting.default
    if setting.option.default or setting.required:
        return setting.option.default or "required"
    if isinstance(default, bool):
        return "on" if default else "off"
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    return f"{default:g}" if isinstance(default, float) else str(default)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
