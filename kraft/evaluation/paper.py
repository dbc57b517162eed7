"""Results of the paper (its Tables I to VI), which the tables of an evaluation have beside their own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from kraft.driving.method import Method, load_method
from kraft.scenario import Scenario, load_scenario


@dataclass(frozen=True)
class PaperRow:
    """Number of trials by outcome, and mean duration of the successful ones (s; None without any)."""

    success: int
    collision: int
    timeout: int
    t_ex: float | None

    @property
    def trials(self) -> int:
        """Number of trials."""
        return self.success + self.collision + self.timeout


_TABLES: Final = {
    "turns": {  # Table I
        "oneshot-openloop": PaperRow(0, 30, 0, None),
        "oneshot-geometric": PaperRow(19, 11, 0, 16.88),
        "oneshot-kinodynamic": PaperRow(23, 7, 0, 15.86),
        "replanner-openloop": PaperRow(5, 25, 0, 17.5),
        "cons-replanner-openloop": PaperRow(11, 15, 4, 30.5),
        "kraft": PaperRow(27, 3, 0, 16.65),
        "conservative-kraft": PaperRow(30, 0, 0, 18.9),
    },
    "boxes": {  # Table I
        "oneshot-openloop": PaperRow(0, 30, 0, None),
        "oneshot-geometric": PaperRow(8, 22, 0, 11.49),
        "oneshot-kinodynamic": PaperRow(17, 13, 0, 13.81),
        "replanner-openloop": PaperRow(0, 30, 0, None),
        "cons-replanner-openloop": PaperRow(8, 13, 9, 39.33),
        "kraft": PaperRow(23, 7, 0, 17.39),
        "conservative-kraft": PaperRow(25, 1, 4, 40.3),
    },
    "slope": {  # Table II
        "oneshot-openloop": PaperRow(0, 30, 0, None),
        "oneshot-geometric": PaperRow(0, 27, 3, None),
        "oneshot-kinodynamic": PaperRow(4, 16, 10, 23.18),
        "kraft": PaperRow(19, 11, 0, 29.94),
    },
    "slip": {  # Table IV
        "oneshot-openloop": PaperRow(0, 30, 0, None),
        "oneshot-geometric": PaperRow(6, 24, 0, 16.86),
        "oneshot-kinodynamic": PaperRow(8, 16, 6, 14.45),
        "kraft": PaperRow(20, 10, 0, 16.4),
    },
    "bump": {  # Table V
        "oneshot-openloop": PaperRow(0, 30, 0, None),
        "oneshot-geometric": PaperRow(13, 16, 1, 17.95),
        "oneshot-kinodynamic": PaperRow(17, 4, 9, 16.17),
        "kraft": PaperRow(24, 6, 0, 19.33),
    },
    "movable": {  # Table VI
        "oneshot-openloop": PaperRow(0, 30, 0, None),
        "oneshot-geometric": PaperRow(1, 28, 1, 24.96),
        "oneshot-kinodynamic": PaperRow(4, 24, 2, 18.79),
        "kraft": PaperRow(17, 12, 1, 29.32),
    },
    "turns-real": {  # Table III, ten trials on the real car
        "oneshot-openloop": PaperRow(0, 10, 0, None),
        "oneshot-kinodynamic": PaperRow(2, 8, 0, 15.325),
        "replanner-openloop": PaperRow(1, 9, 0, 13.26),
        "cons-replanner-openloop": PaperRow(7, 3, 0, 20.61),
        "kraft": PaperRow(10, 0, 0, 14.06),
        "conservative-kraft": PaperRow(10, 0, 0, 31.58),
    },
    "boxes-real": {  # Table III
        "oneshot-openloop": PaperRow(0, 7, 3, None),
        "oneshot-kinodynamic": PaperRow(4, 6, 0, 25.90),
        "replanner-openloop": PaperRow(5, 5, 0, 22.95),
        "cons-replanner-openloop": PaperRow(8, 2, 0, 31.75),
        "kraft": PaperRow(8, 2, 0, 26.91),
        "conservative-kraft": PaperRow(9, 1, 0, 45.55),
    },
}


def paper_row(scenario: str, method: str) -> PaperRow | None:
    """Result of a method in a scenario in the paper, by their bundled names; None if the paper has none."""
    return _TABLES.get(scenario, {}).get(method)


def is_of_paper(scenario: Scenario, method: Method) -> bool:
    """Whether the paper has this method in this scenario: both are the bundled ones of their names, texts apart.

    A file may have the name of a bundled scenario or method and another content.
    """
    if paper_row(scenario.name, method.name) is None:
        return False
    bundled_scenario, bundled_method = load_scenario(scenario.name), load_method(method.name)
    texts = {"title", "description"}
    return replace(scenario, description="") == replace(bundled_scenario, description="") and (
        method.model_dump(exclude=texts) == bundled_method.model_dump(exclude=texts)
    )
