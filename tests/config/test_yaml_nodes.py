"""Reading YAML: what words mean, and that every problem is reported with its place."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.diagnostics import located, raised
from support.paths import ROOT

from kraft.config import yaml_nodes, yaml_reader
from kraft.config.document import Document, Unusable
from kraft.config.source import Position, format_path, parse_path
from kraft.config.yaml_reader import parse_document, read_document
from kraft.errors import Code, Diagnostic, InputError


def problems_of(content: bytes | str) -> tuple[Diagnostic, ...]:
    """Every problem of a file called f.yaml."""
    try:
        return parse_document(content, "f.yaml").problems
    except InputError as error:
        return error.diagnostics


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("on", "on"),
        ("off", "off"),
        ("yes", "yes"),
        ("No", "No"),
        ("y", "y"),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("null", None),
        ("", None),
        ("1:30", "1:30"),
        ("1e3", 1000.0),
        ("1E-3", 0.001),
        ("1.", 1.0),
        (".5", 0.5),
        ("-1", -1),
        ("+1", 1),
        ("0", 0),
        ("-0.0", -0.0),
        ("01.5", 1.5),
        ("2024-01-01", "2024-01-01"),
        ("nan", "nan"),
        ("inf", "inf"),
        ("=", "="),
        ("1e", "1e"),
        ("0x", "0x"),
        ("'012'", "012"),
        ('"on"', "on"),
        ("123456789012345678", 123456789012345678),
    ],
)
def test_a_word_means_the_same_to_everyone(word: str, value: object) -> None:
    data = parse_document(f"a: {word}", "f.yaml").data
    assert isinstance(data, dict)
    assert data["a"] == value
    assert type(data["a"]) is type(value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("a: 012", "1:4 a value"),
        ("a: -007", "1:4 a value"),
        ("a: 0x1F", "1:4 a value"),
        ("a: 1_000", "1:4 a value"),
        ("a: .inf", "1:4 a value"),
        ("a: -.INF", "1:4 a value"),
        ("a: .NaN", "1:4 a value"),
        ("a: 1e999", "1:4 a value"),
        ("a: 1234567890123456789", "1:4 a value"),
        ("a: 1\nb: 2\na: 3", "3:1 a duplicate"),
        ("a: {b: 1, b: 2}", "1:11 a.b duplicate"),
        ("a: &x {b: 1}\nc:\n  <<: *x", "3:3 c syntax"),
        ("a: !!python/object/apply:os.system [ls]", "1:4 a syntax"),
        ("a: !mine 1", "1:4 a syntax"),
        ("a: !!float 1", "1:4 a syntax"),
        ("a: !!str 012", "1:4 a syntax"),
        ("a: !!map {b: 1}", "1:4 a syntax"),
        ("a: !!seq [1]", "1:4 a syntax"),
        ("a: !<tag:yaml.org,2002:str> b", "1:4 a syntax"),
        ("a: ! 5", "1:4 a syntax"),
        ("a: !plain '5'", "1:4 a syntax"),
        ("a: !<plain> '5'", "1:4 a syntax"),
        ("!!map {a: 1}", "1:1 syntax"),
        ("!!str a: 1", "1:1 syntax"),
        ("? [1]\n: 2", "1:3 syntax"),
        ("a: &x [*x]", "1:4 a[0] syntax"),
        ("a: *x", "1:4 syntax"),
        ("a: 1\n---\nb: 2", "2:1 syntax"),
        ("", "1:1 syntax"),
        ("# only a comment\n", "1:1 syntax"),
        ("a:\n\tb: 1", "2:1 syntax"),
        ("a: b: c", "1:5 syntax"),
        ("a: '\nb: 1", "2:5 syntax"),
        ("a: [1, 2", "1:9 syntax"),
        ("a: \x07", "1:4 syntax"),
        ("a: 1\nb: \x00", "2:4 syntax"),
        ('a: "\\ud800"', "1:4 a syntax"),
        ('a: "\\UFFFFFFFF"', "1:7 syntax"),
        (b"a: 1\nb: \xff", "2:4 syntax"),
        (b"\xef\xbb\xbfa: 1\n\xff", "2:1 syntax"),
        ("a: zwölf".encode() + b"\xff", "1:9 syntax"),
        ("a: 1".encode("utf-16"), "1:1 syntax"),
        ("a: " + "[" * 400, "1:53 syntax"),
        ("a: " + "x" * 300_000, "unreadable"),
    ],
)  # fmt: skip
def test_a_problem_is_reported_with_its_place(content: bytes | str, expected: str) -> None:
    assert located(problems_of(content)) == [expected]


def test_every_problem_is_said_at_once_and_the_rest_is_still_read() -> None:
    document = parse_document("a: 012\nb: 1\nb: 2\nc: [.nan, 7]", "f.yaml")
    assert [(p.line, p.path) for p in document.problems] == [(1, "a"), (3, "b"), (4, "c[0]")]
    assert document.problems[0].expected == "expected 12, or quotes where the key takes text"
    assert isinstance(document.data, dict)
    assert document.data["b"] == 1
    assert isinstance(document.data["a"], Unusable)
    assert document.unusable == {("a",), ("c", 0)}


def test_an_alias_is_read_like_what_it_stands_for() -> None:
    document = parse_document("a: &size [1, 2]\nb: *size", "f.yaml")
    assert document.data == {"a": (1, 2), "b": (1, 2)}
    assert document.source.where("b[1]") == Position(1, 14)


def test_an_alias_bomb_is_refused_before_it_grows() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [" + ", ".join([f"*a{i - 1}"] * 10) + "]" for i in range(1, 30)]
    (problem,) = problems_of("\n".join(lines))
    assert (problem.code, problem.expected) == (Code.SYNTAX, "expected fewer aliases")


def test_a_chain_of_aliases_cannot_nest_without_end() -> None:
    chain = ["a0: &a0 [x]", *(f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 2000))]
    assert {problem.expected for problem in problems_of("\n".join(chain))} == {"expected at most 50 levels"}


def test_a_byte_order_mark_is_skipped_and_does_not_shift_columns() -> None:
    document = parse_document(b"\xef\xbb\xbfa: 1", "f.yaml")
    assert document.data == {"a": 1}
    assert document.source.where("a") == Position(1, 4)


def test_values_and_keys_know_their_places() -> None:
    source = parse_document("goal:\n  center: [1, 5]\n  radius: 2\n", "f.yaml").source
    assert source.where("goal.center") == Position(2, 11)
    assert source.where("goal.center[1]") == Position(2, 15)
    assert source.keys["goal", "radius"] == Position(3, 3)


def test_a_key_left_to_its_default_is_at_the_mapping_that_leaves_it_out() -> None:
    source = parse_document("name: x\nstart:\n  y: 1\n", "f.yaml").source
    assert source.where("start.speed") == Position(2, 1)
    assert source.where("planning.safety.delta") == Position(1, 1)


def test_a_file_that_cannot_be_read_is_an_input_error(tmp_path: Path) -> None:
    assert located(raised(lambda: read_document(tmp_path / "none.yaml"))) == ["not-found"]
    assert located(raised(lambda: read_document(tmp_path))) == ["unreadable"]
    assert located(raised(lambda: read_document(Path("a\0b")))) == ["unreadable"]


paths = st.lists(st.one_of(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), st.integers(0, 99)), max_size=5)


@given(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), paths)
def test_a_written_path_reads_back_as_itself(first: str, rest: list[str | int]) -> None:
    assert parse_path(format_path((first, *rest))) == (first, *rest)


@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_an_input_error(content: bytes) -> None:
    problems_of(content)


yaml_like = st.text(alphabet="ab01.:-[]{},&*!'\"|>%#?~<=@`\\ \n\t_xeux\ufeff\u2028", max_size=80)


@given(st.one_of(st.text(max_size=100), yaml_like))
def test_no_text_raises_anything_but_an_input_error(content: str) -> None:
    for problem in problems_of(content):
        str(problem).encode()  # and what it says can be printed


ODD = (
    "a:\r\n - b\r\n",
    "a: |\n  x\n  y\nb: >-\n  u",
    "\ufeffä: 😀 # x\nb: [1, {c: 'd'}]",
    "&a {b: 1}: 2",
    "a: &x [1]\nb: *x",
    "",
)


def test_libyaml_and_the_parser_of_pyyaml_read_the_same_values_at_the_same_places(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    files = [path.read_text(encoding="utf-8") for room in ("configs", "scenarios") for path in files_of(room)]
    assert len(files) > 50

    def read(content: str) -> Document | tuple[Diagnostic, ...]:
        yaml_reader._root.cache_clear()
        try:
            return parse_document(content, "f.yaml")
        except InputError as error:
            return error.diagnostics

    fast = [read(content) for content in (*files, *ODD)]
    monkeypatch.setattr(yaml_nodes, "_FastLoader", yaml_nodes._Loader)
    assert [read(content) for content in (*files, *ODD)] == fast


def files_of(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.yaml"))
