"""HTML and SVG as trees of elements; all text is escaped."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any, Final, TypeAlias
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

NO_VALUE: Final = "–"
"""Text of a cell without a value."""
Content: TypeAlias = Element | str | None
Value: TypeAlias = str | float | None


def element(tag: str, *content: Content, **attributes: Value) -> Element:
    """Make an element; None in content and attributes is skipped.

    Attributes are written as Python names: ``class_`` is class, ``stroke_width`` is stroke-width.
    """
    found = Element(tag)
    for name, value in attributes.items():
        if value is not None:
            found.set(name.rstrip("_").replace("_", "-"), value if isinstance(value, str) else number(value))
    for child in content:
        _append(found, child)
    return found


def svg(width: float, height: float, *content: Content, **attributes: Value) -> Element:
    """Make a drawing of a size in pixels."""
    drawing = element("svg", *content, width=width, height=height, **{"role": "img", **attributes})
    drawing.set("viewBox", f"0 0 {number(width)} {number(height)}")
    return drawing


def stacked(table: Element) -> Element:
    """Give the cells of a table the texts of their headings, which a narrow screen shows in place of the first row.

    A cell below a heading with a drawing, an axis, is marked: it cannot be read without it.
    """
    heading, *rows = table.iter("tr")
    heading.set("class", "headings")
    for row in rows:
        for above, cell in zip(heading, row, strict=False):
            if cell.tag == "td" and (label := _label(above)):
                cell.set("data-label", label)
            if cell.tag == "td" and above.find("svg") is not None:
                cell.set("class", f"{cell.get('class', '')} under-axis".strip())
    table.set("data-stacked", "")
    return table


def _label(heading: Element) -> str:
    """Words of a heading, without those of its drawing."""
    return ", ".join(text for text in (heading.text, *(small.text for small in heading.iter("small"))) if text)


def outcome_legend(failed: bool, *, soft: bool = False) -> list[Element]:
    """Names of the outcomes success, timeout, collision and, if there is one, failed, each with its colour.

    The `soft` colours are those of cells with words on them.
    """
    looks = ("success", "timeout", "collision", *(["failed"] if failed else []))
    shade = " soft" if soft else ""
    return [element("span", element("i", class_=f"swatch {look}{shade}"), f" {look}") for look in looks]


def number(value: float) -> str:
    """Length or coordinate with six digits."""
    return f"{value + 0.0:.6g}"


def document(title: str, style: str, *content: Content, scripts: Iterable[Element] = ()) -> str:
    """Make a page that refers to no other file; `scripts` come last."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("link", rel="icon", href="data:,"),  # otherwise browsers ask a server for one
        element("title", title),
        element("style", style),
    )
    page = element("html", head, element("body", element("main", *content), *scripts), lang="en")
    return "<!DOCTYPE html>\n" + ElementTree.tostring(page, encoding="unicode", method="html") + "\n"


def script_data(name: str, content: Any) -> Element:
    """JSON for the page's script; what anybody wrote cannot end it, because ``<`` is escaped."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return element("script", text, type="application/json", id=name)


def _append(parent: Element, child: Content) -> None:
    if child is None:
        return
    if isinstance(child, Element):
        parent.append(child)
    elif len(parent):
        parent[-1].tail = (parent[-1].tail or "") + child
    else:
        parent.text = (parent.text or "") + child


def hint(text: str) -> Element:
    """Words about what a reader can do, which a print does not have."""
    return element("span", text, class_="hint")
