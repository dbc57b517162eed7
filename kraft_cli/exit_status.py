"""Exit codes of kraft."""

from enum import IntEnum


class ExitStatus(IntEnum):
    """Exit codes, the same for every command."""

    DONE = 0
    NEGATIVE = 1
    """it ran with a negative result: no plan found, parameters not identifiable"""
    INVALID = 2
    """invalid usage or input"""
    MISSING = 3
    """a dependency or asset is missing"""
    INTERNAL = 70
    """a defect in kraft"""
    HUNG_UP = 129
    INTERRUPTED = 130
    TERMINATED = 143
