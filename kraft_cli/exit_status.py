"""What kraft's exit codes mean."""

from enum import IntEnum


class ExitStatus(IntEnum):
    """Exit codes, the same for every command."""

    DONE = 0
    NEGATIVE = 1
    """it ran, and the answer is no: no plan found, parameters not identifiable"""
    INVALID = 2
    """usage or input is wrong"""
    MISSING = 3
    """a dependency or asset is missing"""
    INTERNAL = 70
    """a defect in kraft"""
    INTERRUPTED = 130
