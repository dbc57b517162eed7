"""Arguments whose bytes are not text in the encoding of file names."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from kraft.config.document import holds_surrogate
from kraft.errors import Code, Diagnostic, InputError

ASCII: Final = "ascii"
"""Encoding of file names with LC_ALL=C and PYTHONUTF8=0, as Python calls it."""


def check_names(arguments: Sequence[str]) -> None:
    """Check that every argument is text that can be written to the files of kraft, which are in UTF-8.

    Raises:
        InputError: Python could not decode bytes of an argument, and has surrogates for them.
    """
    encoding = sys.getfilesystemencoding()
    problem = f"has bytes that are not text in the encoding of file names, {encoding}"
    expected = f"expected a name in {encoding}"
    if encoding == ASCII:
        expected += ", or a locale with UTF-8, as with LC_ALL=C.UTF-8 and without PYTHONUTF8=0"
    wrong = [argument for argument in arguments if holds_surrogate(argument)]
    if wrong:
        shown = [argument.encode(errors="backslashreplace").decode() for argument in wrong]
        raise InputError(Diagnostic(name, problem, expected, code=Code.VALUE) for name in shown)
