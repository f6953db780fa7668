"""Line numbers of keys in TOML texts, the awkward ones included."""

import tomllib
from pathlib import Path

import pytest

from mpmcli.scene.toml_file import key_lines, line_of

AWKWARD = '''\
# a comment with [brackets] and = signs
"quoted key" = "a # no comment" # a comment
'literal.key' = 1979-05-27 07:32:00
text = """
[not.a.table]
x = "1" \\" """" # ends with one quote of its own
raw = \'\'\'
]] }}
\'\'\'
a.b . "c d" = { e = [1, 2], f.g = "}" }

[table]
list = [ # the first
    [1.0, 2], # ]
    { x = 1, y = "[" },

    "three",
]
  [ table . inner ]
  k = true
[[bodies]]
name = "a"
[bodies.shape]
radius = 1e-3
[[bodies.shape.points]]
x = 1
[[bodies.shape.points]]
x = 2
[[bodies]]
name = "b"
shape.box = {}
'''


def test_every_key_of_an_awkward_text():
    tomllib.loads(AWKWARD)
    lines = key_lines(AWKWARD)
    assert lines == {
        ("quoted key",): 2,
        ("literal.key",): 3,
        ("text",): 4,
        ("raw",): 7,
        ("a",): 10,
        ("a", "b"): 10,
        ("a", "b", "c d"): 10,
        ("a", "b", "c d", "e"): 10,
        ("a", "b", "c d", "e", 0): 10,
        ("a", "b", "c d", "e", 1): 10,
        ("a", "b", "c d", "f"): 10,
        ("a", "b", "c d", "f", "g"): 10,
        ("table",): 12,
        ("table", "list"): 13,
        ("table", "list", 0): 14,
        ("table", "list", 0, 0): 14,
        ("table", "list", 0, 1): 14,
        ("table", "list", 1): 15,
        ("table", "list", 1, "x"): 15,
        ("table", "list", 1, "y"): 15,
        ("table", "list", 2): 17,
        ("table", "inner"): 19,
        ("table", "inner", "k"): 20,
        ("bodies",): 21,
        ("bodies", 0): 21,
        ("bodies", 0, "name"): 22,
        ("bodies", 0, "shape"): 23,
        ("bodies", 0, "shape", "radius"): 24,
        ("bodies", 0, "shape", "points"): 25,
        ("bodies", 0, "shape", "points", 0): 25,
        ("bodies", 0, "shape", "points", 0, "x"): 26,
        ("bodies", 0, "shape", "points", 1): 27,
        ("bodies", 0, "shape", "points", 1, "x"): 28,
        ("bodies", 1): 29,
        ("bodies", 1, "name"): 30,
        ("bodies", 1, "shape"): 31,
        ("bodies", 1, "shape", "box"): 31,
    }
    assert key_lines(AWKWARD.replace("\n", "\r\n")) == lines


def test_what_is_missing_is_where_the_table_around_it_is():
    lines = key_lines(AWKWARD)
    assert line_of(("bodies", 1, "material", "law"), lines) == 29
    assert line_of(("nowhere",), lines) is None
    assert key_lines("") == {}


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parent.parent / "configs").glob("*.toml")), ids=lambda p: p.stem
)
def test_the_line_of_every_key_of_the_configs_holds_the_key(path):
    text = path.read_text(encoding="utf-8")
    lines = key_lines(text)

    def walk(value, at):
        if isinstance(value, dict):
            for key, inner in value.items():
                assert key in text.splitlines()[lines[(*at, key)] - 1]
                walk(inner, (*at, key))
        elif isinstance(value, list):
            for i, inner in enumerate(value):
                assert (*at, i) in lines
                walk(inner, (*at, i))

    walk(tomllib.loads(text), ())
