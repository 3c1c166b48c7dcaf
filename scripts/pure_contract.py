"""A contract of import-linter: all modules are pure, except the modules that the contract names.

import-linter's own type ``forbidden`` takes a list of pure modules, and a new module is not on it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from grimp import ImportGraph
from importlinter.contracts.forbidden import ForbiddenContract
from importlinter.domain import fields
from importlinter.domain.contract import ContractCheck
from importlinter.domain.helpers import module_expressions_to_modules
from importlinter.domain.imports import ModuleExpression


class RoomsField(fields.Field[Any]):
    """Module expressions by package: ``{"rosproxy.net": ["proxy_signs"]}`` is
    rosproxy.net.proxy_signs."""

    def parse(self, raw_data: Any) -> set[ModuleExpression]:
        """Return the full module expressions."""
        rooms: Mapping[str, Sequence[str]] = raw_data
        return {
            ModuleExpression(f"{room}.{name}") for room, names in rooms.items() for name in names
        }


class PureContract(ForbiddenContract):
    """No module of ``root_packages`` imports a forbidden module or a module of ``io_modules``.

    The modules of ``io_modules`` themselves may import everything.
    """

    type_name = "pure"
    source_modules = fields.SetField(subfield=fields.ModuleExpressionField(), required=False)
    io_modules = RoomsField()

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Check the direct imports of each pure module: what it imports is pure as well."""
        expressions: set[ModuleExpression] = vars(self)["io_modules"]
        io = module_expressions_to_modules(graph, expressions, raise_if_unmatched=True)
        roots = self.session_options["root_packages"]
        modules = module_expressions_to_modules(
            graph, [ModuleExpression(f"{root}.**") for root in roots]
        )
        forbidden = {*vars(self)["forbidden_modules"], *(ModuleExpression(m.name) for m in io)}
        vars(self).update(
            source_modules={ModuleExpression(module.name) for module in modules - io},
            forbidden_modules=forbidden,
            allow_indirect_imports=True,
            as_packages=False,
        )
        return super().check(graph, verbose)
