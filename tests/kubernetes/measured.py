"""Numbers that the tests have measured, shown when all have run."""

NUMBERS: list[str] = []


def note(measurement: str) -> None:
    NUMBERS.append(measurement)
    print(measurement)
