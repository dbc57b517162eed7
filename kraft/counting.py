"""Numbers of things, in a sentence."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """``1 trial``, ``2 trials``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def grouped(number: int, noun: str) -> str:
    """The same for numbers that may be large: ``20,000 iterations``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
