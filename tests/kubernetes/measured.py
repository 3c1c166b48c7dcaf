"""Numbers that the tests have measured, shown when all have run."""

NUMBERS: list[str] = []


def note(what: str) -> None:
    NUMBERS.append(what)
    print(what)
