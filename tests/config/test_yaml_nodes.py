"""Reading YAML: what words mean, and that whatever is wrong is said with its place."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kraft.config.source import Position, format_path, parse_path
from kraft.config.yaml_reader import Unusable, parse_document, read_document
from kraft.errors import InputError


def problems_of(content: bytes | str) -> list[str]:
    """Every line kraft says about a file called f.yaml."""
    try:
        return [str(p) for p in parse_document(content, "f.yaml").problems]
    except InputError as error:
        return str(error).splitlines()


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
        ("!!str 012", "012"),
        ("123456789012345678", 123456789012345678),
    ],
)
def test_a_word_means_the_same_to_everyone(word: str, value: object) -> None:
    data = parse_document(f"a: {word}", "f.yaml").data
    assert isinstance(data, dict)
    assert data["a"] == value
    assert type(data["a"]) is type(value)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("a: 012", "f.yaml:1:4: a: 012 is octal to some YAML readers and decimal to others; expected 12, or quotes if it is text"),
        ("a: -007", "f.yaml:1:4: a: -007 is octal to some YAML readers and decimal to others; expected -7, or quotes if it is text"),
        ("a: 0x1F", "f.yaml:1:4: a: 0x1F is a number to some YAML readers and text to others; expected a plain decimal number, or quotes if it is text"),
        ("a: 1_000", "f.yaml:1:4: a: 1_000 is a number to some YAML readers and text to others; expected a plain decimal number, or quotes if it is text"),
        ("a: .inf", "f.yaml:1:4: a: .inf is not a finite number; expected a finite number"),
        ("a: -.INF", "f.yaml:1:4: a: -.INF is not a finite number; expected a finite number"),
        ("a: .NaN", "f.yaml:1:4: a: .NaN is not a finite number; expected a finite number"),
        ("a: 1e999", "f.yaml:1:4: a: the number 1e999 is too large; expected a finite number"),
        ("a: 1234567890123456789", "f.yaml:1:4: a: the number 1234567890123456789 is too large; expected at most 18 digits"),
        ("a: 1\nb: 2\na: 3", "f.yaml:3:1: a: the key is repeated; it is first at line 1, column 1; expected it once"),
        ("a: {b: 1, b: 2}", "f.yaml:1:11: a.b: the key is repeated; it is first at line 1, column 5; expected it once"),
        ("a: &x {b: 1}\nc:\n  <<: *x", "f.yaml:3:3: c: merge keys (<<) are not supported; expected the keys written out"),
        ("a: !!python/object/apply:os.system [ls]", "f.yaml:1:4: a: the tag !!python/object/apply:os.system is not supported; expected the value without a tag"),
        ("a: !mine 1", "f.yaml:1:4: a: the tag !mine is not supported; expected the value without a tag"),
        ("a: !!float 1", "f.yaml:1:4: a: the tag !!float is not supported; expected the value without a tag"),
        ("? [1]\n: 2", "f.yaml:1:3: a key is a list, a mapping or tagged; expected keys that are words"),
        ("a: &x [*x]", "f.yaml:1:4: a[0]: the alias stands for something it is part of; expected a finite value"),
        ("a: *x", "f.yaml:1:4: not valid YAML (found undefined alias 'x'); expected YAML, such as 'key: value'"),
        ("a: 1\n---\nb: 2", "f.yaml:2:1: a second document begins here; expected one document in a file"),
        ("", "f.yaml:1:1: the file is empty; expected a mapping"),
        ("# only a comment\n", "f.yaml:1:1: the file is empty; expected a mapping"),
        ("a:\n\tb: 1", "f.yaml:2:1: a tab is used for indentation; expected spaces"),
        ("a: b: c", "f.yaml:1:5: not valid YAML (mapping values are not allowed here); expected YAML, such as 'key: value'"),
        ("a: '\nb: 1", "f.yaml:2:5: not valid YAML (found unexpected end of stream, while scanning a quoted scalar); expected YAML, such as 'key: value'"),
        ("a: [1, 2", "f.yaml:1:9: not valid YAML (expected ',' or ']', but got '<stream end>', while parsing a flow sequence); expected YAML, such as 'key: value'"),
        ("a: \x07", "f.yaml:1:4: the character U+0007 is not allowed; expected printable text"),
        ("a: 1\nb: \x00", "f.yaml:2:4: the character U+0000 is not allowed; expected printable text"),
        ('a: "\\ud800"', "f.yaml:1:4: a: holds half of a character; expected text that UTF-8 can write"),
        ('a: "\\UFFFFFFFF"', "f.yaml:1:7: not valid YAML (a number out of range); expected YAML, such as 'key: value'"),
        (b"a: 1\nb: \xff", "f.yaml:2:4: is not UTF-8 text; expected the file saved as UTF-8"),
        ("a: 1".encode("utf-16"), "f.yaml:1:1: is not UTF-8 text; expected the file saved as UTF-8"),
        ("a: " + "[" * 400, "f.yaml:1:53: nested too deep; expected at most 50 levels"),
        ("a: " + "x" * 300_000, "f.yaml: is larger than 256 KiB; expected a configuration file"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_place(content: bytes | str, line: str) -> None:
    assert problems_of(content) == [line]


def test_every_problem_is_said_at_once_and_the_rest_is_still_read() -> None:
    document = parse_document("a: 012\nb: 1\nb: 2\nc: [.nan, 7]", "f.yaml")
    assert [(p.line, p.path) for p in document.problems] == [(1, "a"), (3, "b"), (4, "c[0]")]
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
    (line,) = problems_of("\n".join(lines))
    assert line.endswith("holds more than 100000 values; expected fewer aliases")


def test_a_chain_of_aliases_cannot_nest_without_end() -> None:
    chain = ["a0: &a0 [x]", *(f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 2000))]
    assert all("nested too deep" in line for line in problems_of("\n".join(chain)))


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
    with pytest.raises(InputError, match=r"none.yaml: there is no such file; expected a YAML file"):
        read_document(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        read_document(tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        read_document(Path("a\0b"))


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
    for line in problems_of(content):
        line.encode()  # and what it says can be printed
