"""Messages of commands in processes of their own."""

from __future__ import annotations

from kraft.elapsed import LOADING


def without_loading(text: str) -> str:
    """Messages without those about modules that are loaded, which a busy machine shows."""
    return "".join(line for line in text.splitlines(keepends=True) if not line.endswith(f" s: {LOADING}\n"))
