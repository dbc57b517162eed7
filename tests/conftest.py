"""What every test has."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="session")
def default_interrupts() -> Iterator[None]:
    """Interrupts raise KeyboardInterrupt here and in processes that tests start, also where they were ignored before.

    A process that ignores SIGINT, as those under nohup or in the background of a script do, hands that on to the
    processes it starts; one that handles it does not.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
