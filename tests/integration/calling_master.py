"""A master that calls back at the subscribers of parameters, as the real one does."""

from typing import Any

from tests.integration.master import Master, Triple


class CallingMaster(Master):
    """``calls_back`` switched off: one that can't reach anybody."""

    def __init__(self) -> None:
        super().__init__()
        self.calls_back = True

    def _do_set_param(self, caller: str, key: str, held: Any) -> Triple:
        for uri in self.holds("params", key) if self.calls_back else ():
            self._told.append((uri, "paramUpdate", (key, held)))
        return super()._do_set_param(caller, key, held)

    def _do_delete_param(self, _caller: str, key: str) -> Triple:
        if key not in self.params:
            return [-1, f"parameter [{key}] is not set", 0]
        del self.params[key]
        return [1, f"parameter {key} deleted", 0]
