"""Write the tables of settings in docs/reference/options.md.

    python -m scripts.options_docs

Each table stands between two comments with the name of a program. The rows come from the
annotations of the program's settings classes. Example: ``rosproxy run`` has the class
`rosproxy.shared.settings.Settings`.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

from rosproxy.shared.setting_kinds import Setting, declared
from rosproxy.shared.settings import Settings
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.kubernetes.settings import (
    Bounds,
    ClusterSettings,
    KubernetesSettings,
    WebhookSettings,
)

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/reference/options.md"
SETTINGS: dict[str, tuple[type, ...]] = {
    "rosproxy run": (Settings,),
    "rosproxy-operator docker": (PlanSettings,),
    "rosproxy-operator kubernetes": (
        *(ClusterSettings, Bounds, KubernetesSettings, WebhookSettings),
    ),
}
"""The settings classes of each program."""


def with_new_tables(text: str) -> str:
    """Return the page with new tables."""
    for program, classes in SETTINGS.items():
        begin = f"<!-- {program} -->\n"
        end = f"<!-- end of {program} -->"
        before, rest = text.split(begin)
        declarations = map(declared, classes)
        table = "\n".join(_table(setting for settings in declarations for setting in settings))
        text = f"{before}{begin}\n{table}\n\n{end}{rest.split(end)[1]}"
    return text


def _table(settings: Iterable[Setting]) -> Iterator[str]:
    yield from ("| option | variable | default | meaning |", "|---|---|---|---|")
    for setting in settings:
        cells = (_option(setting), _variables(setting), _default(setting), setting.option.help)
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _option(setting: Setting) -> str:
    kind = setting.option.kind
    form = kind.form if kind else "|".join(filter(None, setting.words))
    if setting.default is True:
        return f"`{setting.name}`, `--no-{setting.name.removeprefix('--')}`"
    return f"`{setting.name} {form}`" if form else f"`{setting.name}`"


def _variables(setting: Setting) -> str:
    names = ", ".join(f"`{name}`" for name in setting.variables)
    return f"{names} ({setting.option.note})" if setting.option.note else names


def _default(setting: Setting) -> str:
    default = setting.default
    if setting.option.default or setting.required:
        return setting.option.default or "required"
    if isinstance(default, bool):
        return "on" if default else "off"
    if isinstance(default, tuple):
        return ", ".join(map(str, default))
    return f"{default:g}" if isinstance(default, float) else str(default)


if __name__ == "__main__":
    PAGE.write_text(with_new_tables(PAGE.read_text()))
