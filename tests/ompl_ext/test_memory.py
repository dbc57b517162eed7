"""Memory of maps: what is said to be needed bounds what is taken, and too much is refused before it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ompl_ext import memory
from ompl_ext.kernels import clearance
from ompl_ext.kernels.clearance import cover, fields, memory_of_fields
from ompl_ext.memory import MapTooLargeError, available_memory, check_memory, in_words
from ompl_ext.obstacles import Circle, OccupancyGrid, Workspace
from ompl_ext.vehicle import Footprint

FOOTPRINT = Footprint(0.4, 0.28)


def map_of(cells: int, share: float, resolution: float = 0.05) -> Workspace:
    occupied = np.random.default_rng(0).random((cells, cells)) < share
    side = cells * resolution
    return Workspace(((0.0, side), (0.0, side)), (OccupancyGrid(occupied, resolution, (0.0, 0.0, 0.0)),))


@pytest.mark.parametrize("workspace", [
    map_of(300, 0.01), map_of(300, 0.3), map_of(100, 0.01, 0.3), map_of(500, 0.0),
    Workspace(((0.0, 100.0), (0.0, 100.0)), (Circle(np.array([50.0, 50.0]), 3.0),)), Workspace(((0.0, 5.0), (0.0, 5.0))),
])  # fmt: skip
def test_the_fields_are_no_larger_than_was_said(workspace: Workspace) -> None:
    field, fine = fields(workspace, FOOTPRINT, cover(FOOTPRINT).radius, 0.02)
    stored = 2 * field.values.nbytes + (0 if fine is None else fine.tile.nbytes + fine.squares.nbytes)
    assert stored <= memory_of_fields(workspace, FOOTPRINT, 0.02)


def test_twenty_million_cells_need_less_than_two_gigabytes() -> None:
    assert memory_of_fields(map_of(4473, 0.0), FOOTPRINT, 0.02) < 2e9


def test_a_map_larger_than_memory_is_refused_before_any_of_it_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 1_000_000)
    monkeypatch.setattr(clearance, "map_cells", None)
    with pytest.raises(MapTooLargeError) as error:
        fields(map_of(300, 0.01), FOOTPRINT, cover(FOOTPRINT).radius, 0.02)
    assert error.value.available == 1_000_000 < error.value.needed


def test_what_is_available_is_some_of_this_machine() -> None:
    assert 1e6 < available_memory() < 1e14
    check_memory(1000)
    assert [in_words(size) for size in (2_340_000_000, 12_600_000, -5)] == ["2.3 GB", "13 MB", "0 MB"]


def test_what_a_control_group_gives_back_is_available(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(memory, "GROUP", tmp_path)
    (tmp_path / "memory.max").write_text("2000000\n")
    (tmp_path / "memory.current").write_text("1900000\n")
    assert available_memory() == 100_000
    (tmp_path / "memory.stat").write_text("anon 400000\ninactive_file 1200000\nactive_file 100\n")
    assert available_memory() == 1_300_000
