"""Occupancy maps: what a pixel means, which way is up, and broken images."""

from __future__ import annotations

import contextlib
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from support.diagnostics import located, raised

from kraft.errors import InputError
from kraft.scenario import OccupancyMap, load_scenario
from kraft.scenario.geometry import read_map

YAML = "image: m.pgm\nresolution: 0.5\norigin: [1.0, 2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
P2 = b"P2\n# comment\n3 2\n255\n0 254 254\n254 205 254\n"


def written(folder: Path, image: bytes, text: str = YAML, name: str = "m.pgm") -> OccupancyMap:
    (folder / name).write_bytes(image)
    (folder / "m.yaml").write_text(text)
    return read_map(folder / "m.yaml", height=0.2, name=None)


def refused(folder: Path, image: bytes, text: str = YAML) -> list[str]:
    return located(raised(lambda: written(folder, image, text)))


def test_the_first_row_of_cells_is_the_last_row_of_pixels(tmp_path: Path) -> None:
    grid = written(tmp_path, P2)
    assert grid.occupied.tolist() == [[False, True, False], [True, False, False]]
    assert (grid.resolution, grid.origin) == (0.5, (1.0, 2.0, 0.0))
    assert not grid.occupied.flags.writeable


def test_binary_and_plain_pgm_and_png_say_the_same(tmp_path: Path) -> None:
    plain = written(tmp_path, P2)
    binary = written(tmp_path, b"P5 3 2 255\n" + bytes([0, 254, 254, 254, 205, 254]))
    Image.fromarray(np.array([[0, 254, 254], [254, 205, 254]], dtype=np.uint8)).save(tmp_path / "m.png")
    png = written(tmp_path, b"", YAML.replace("m.pgm", "m.png"))
    assert plain == binary == png


def test_a_cell_that_the_map_does_not_know_is_occupied(tmp_path: Path) -> None:
    pixels = bytes([254, 205, 128, 0])  # free, unknown, between the thresholds, occupied
    for mode in ("trinary", "scale"):
        grid = written(tmp_path, b"P5 4 1 255\n" + pixels, YAML + f"mode: {mode}\n")
        assert grid.occupied.tolist() == [[False, True, True, True]]
    generous = YAML.replace("free_thresh: 0.196", "free_thresh: 0.25")
    assert written(tmp_path, b"P5 4 1 255\n" + pixels, generous).occupied.tolist() == [[False, False, True, True]]


def test_transparent_cells_are_occupied(tmp_path: Path) -> None:
    Image.fromarray(np.array([[[255, 255], [255, 0]]], dtype=np.uint8)).save(tmp_path / "m.png")
    assert written(tmp_path, b"", YAML.replace("m.pgm", "m.png")).occupied.tolist() == [[False, True]]


def test_a_transparent_colour_of_sixteen_bits_is_occupied(tmp_path: Path) -> None:
    pixels = np.array([[65535, 60000, 0]], dtype=np.uint16)
    Image.fromarray(pixels).save(tmp_path / "m.png", transparency=60000)
    assert written(tmp_path, b"", YAML.replace("m.pgm", "m.png")).occupied.tolist() == [[False, True, True]]


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_a_transparent_grey_is_occupied_whatever_bits_it_has(bits: int, tmp_path: Path) -> None:
    white = 2**bits - 1
    row = np.array([white, 0, white, white]) if bits == 1 else np.array([white, white - 1, white, white])
    pixels = b"\0" + np.packbits(np.unpackbits(row.astype(np.uint8)[:, None], axis=1)[:, -bits:]).tobytes()
    chunks = {b"IHDR": struct.pack(">IIBBBBB", 4, 1, bits, 0, 0, 0, 0), b"tRNS": struct.pack(">H", white)}
    chunks |= {b"IDAT": zlib.compress(pixels), b"IEND": b""}
    packed = (struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
              for kind, data in chunks.items())  # fmt: skip
    generous = YAML.replace("m.pgm", "m.png").replace("free_thresh: 0.196", "free_thresh: 0.6")
    grid = written(tmp_path, b"\x89PNG\r\n\x1a\n" + b"".join(packed), generous, "m.png")
    assert grid.occupied.tolist() == [[True, bits == 1, True, True]]


def test_negate_swaps_black_and_white(tmp_path: Path) -> None:
    for flag in ("1", "true"):
        grid = written(tmp_path, b"P5 2 1 255\n" + bytes([0, 255]), YAML.replace("negate: 0", f"negate: {flag}"))
        assert grid.occupied.tolist() == [[False, True]]


def test_raw_pixels_are_occupancy_in_percent(tmp_path: Path) -> None:
    grid = written(tmp_path, b"P5 4 1 255\n" + bytes([0, 19, 60, 255]), YAML + "mode: raw\n")
    assert grid.occupied.tolist() == [[False, False, True, True]]


def test_sixteen_bit_images_are_read(tmp_path: Path) -> None:
    grid = written(tmp_path, b"P5 2 1 65535\n" + bytes([0, 0, 255, 255]))
    assert grid.occupied.tolist() == [[True, False]]


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (b"P5 3 2 255\n\0\0\0", "unreadable"),
        (b"P2\n3 2\n255\n0 254", "unreadable"),
        (b"P5 3", "unreadable"),
        (b"P5 0 0 255\n", "syntax"),
        (b"P5 99999 99999 255\n", "value"),
        (b"P5 9000 9000 255\n", "value"),
        (b"\x89PNG\r\n\x1a\n1234", "syntax"),
        (b"GIF89a", "syntax"),
        (b"Pf\n2 1\n-1.0\n" + bytes(8), "syntax"),
        (b"", "syntax"),
    ],
)
def test_a_broken_image_is_reported_at_the_line_that_names_it(image: bytes, expected: str, tmp_path: Path) -> None:
    assert refused(tmp_path, image) == [f"1:8 image {expected}"]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("m.pgm", "n.pgm", "1:8 image not-found"),
        ("m.pgm", ".", "1:8 image not-found"),
        ("resolution: 0.5", "resolution: 0", "2:13 resolution value"),
        ("[1.0, 2.0, 0.0]", "[1.0, 2.0]", "3:9 origin value"),
        ("negate: 0", "negate: 2", "4:9 negate value"),
        ("free_thresh: 0.196", "free_thresh: 0.7", "6:14 free_thresh conflict"),
        ("negate: 0", "mode: trinry", "4:7 mode value"),
        ("negate: 0", "mode: raw\nnegate: 1", "5:9 negate conflict"),
    ],
)  # fmt: skip
def test_a_wrong_map_file_is_explained(old: str, new: str, expected: str, tmp_path: Path) -> None:
    assert refused(tmp_path, P2, YAML.replace(old, new)) == [expected]


def test_a_scenario_holds_the_map_it_names_and_reports_its_problems(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "name: x\nbounds: {x: [0, 4], y: [0, 4]}\nstart: {x: 1, y: 1, heading_deg: 0}\n"
        "goal: {center: [3, 3], radius: 0.5}\nobstacles:\n  - {name: floor, map: {file: maps/m.yaml, height: 0.4}}\n"
    )
    (tmp_path / "maps").mkdir()
    expected = written(tmp_path / "maps", P2)
    grid = load_scenario(scene).obstacles[0]
    assert isinstance(grid, OccupancyMap)
    assert np.array_equal(grid.occupied, expected.occupied)
    assert (grid.name, grid.height) == ("floor", 0.4)
    (tmp_path / "maps" / "m.pgm").write_bytes(b"P5 3 2 255\n")
    (problem,) = raised(lambda: load_scenario(scene))
    assert problem.file == str(tmp_path / "maps" / "m.yaml")
    assert located([problem]) == ["1:8 image unreadable"]


def test_problems_of_the_keys_and_of_the_image_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(YAML.replace("0.5", "-1", 1).replace("0.196", "3").replace("m.pgm", "none.pgm"))
    found = located(raised(lambda: read_map(tmp_path / "m.yaml", height=0.2, name=None)))
    assert "1:8 image not-found" in found
    assert {each.split()[1] for each in found} == {"image", "resolution", "free_thresh"}


@pytest.mark.parametrize("kind", ["pgm", "png", "pbm"])
def test_an_image_in_place_of_the_file_of_a_map_is_said_to_be_one(kind: str, tmp_path: Path) -> None:
    image = tmp_path / f"m.{kind}"
    Image.new("1" if kind == "pbm" else "L", (3, 2), 255).save(image)
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "name: x\nbounds: {x: [0, 4], y: [0, 4]}\nstart: {x: 1, y: 1, heading_deg: 0}\n"
        f"goal: {{center: [3, 3], radius: 0.5}}\nobstacles:\n  - {{map: {{file: {image.name}}}}}\n"
    )
    (problem,) = raised(lambda: load_scenario(scene))
    assert located([problem]) == ["6:18 obstacles[0].map.file mismatch"]
    assert (problem.file, problem.problem) == (str(scene), f"{image} is an image")
    (problem,) = raised(lambda: read_map(image, height=0.2, name=None))
    assert (problem.file, problem.problem) == (str(image), "is an image")


def test_a_turned_map_turns_its_boxes() -> None:
    grid = OccupancyMap(np.array([[False, True]]), 1.0, (1.0, 2.0, math.pi / 2))
    (box,) = grid.boxes()
    assert box.center == pytest.approx((0.5, 3.5))
    assert (box.size, box.yaw) == ((1.0, 1.0), math.pi / 2)


def cells(grid: OccupancyMap) -> NDArray[np.int64]:
    """How many boxes cover each cell of an unturned map at the origin."""
    count = np.zeros(grid.occupied.shape, dtype=np.int64)
    for box in grid.boxes():
        (x, y), (length, width) = box.center, box.size
        count[round(y - width / 2) : round(y + width / 2), round(x - length / 2) : round(x + length / 2)] += 1
    return count


@given(st.integers(1, 9), st.integers(1, 9), st.randoms(use_true_random=False))
def test_boxes_cover_each_occupied_cell_once_and_no_other(rows: int, columns: int, random: object) -> None:
    occupied = np.array([[random.random() < 0.5 for _ in range(columns)] for _ in range(rows)])  # type: ignore[attr-defined]
    grid = OccupancyMap(occupied, 1.0, (0.0, 0.0, 0.0))
    assert np.array_equal(cells(grid), occupied.astype(np.int64))


@given(
    st.binary(max_size=120),
    st.sampled_from([b"", b"P5 3 2 255\n", b"P2\n3 2\n", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"]),
)
def test_no_image_raises_anything_but_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, head: bytes
) -> None:
    folder = tmp_path_factory.getbasetemp()
    with contextlib.suppress(InputError):
        written(folder, head + content)


def test_an_image_larger_than_memory_is_refused_at_its_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kraft.scenario.geometry.available_memory", lambda: 100)
    with pytest.raises(InputError) as error:
        written(tmp_path, P2)
    (problem,) = error.value.diagnostics
    assert (problem.path, problem.line) == ("image", 1)


@pytest.mark.parametrize("free", [254, 255])
def test_an_unknown_cell_of_map_saver_is_occupied_with_the_threshold_that_ros_2_writes(
    free: int, tmp_path: Path
) -> None:
    saved, settings = bytes([free, 205, 205, 0]), YAML.replace("free_thresh: 0.196", "free_thresh: 0.25")
    image = b"P5 4 1 255\n" + saved
    assert written(tmp_path, image, settings).occupied.tolist() == [[False, True, True, True]]
    for other in (settings + "mode: scale\n", settings.replace("negate: 0", "negate: 1")):
        as_ros = written(tmp_path, image, other).occupied.tolist()
        assert as_ros == ([[False, False, False, True]] if "scale" in other else [[True, True, True, False]])
    drawn = written(tmp_path, b"P5 4 1 255\n" + bytes([free, 205, 230, 0]), settings)
    assert drawn.occupied.tolist() == [[False, False, False, True]]
