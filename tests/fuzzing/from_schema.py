"""Scenes that follow the JSON Schema: any branch, any optional key, numbers at and beyond their bounds."""

import json
from functools import cache
from random import Random
from typing import Any

from command import CONFIGS

from fuzzing.mutation import NUMBERS, TEXTS, paths_of, value_mutant

Node = dict[str, Any]
WORDS = ("drop", "left", "t", "x", "sin(t)", "0.1*x", "-9.81", "auto", "2*pi*t", "velocity", "X if X > 1 else Y")
DEEPEST = 7


@cache
def schema() -> Node:
    """Return the schema of scenes."""
    return json.loads((CONFIGS / "scene.schema.json").read_text(encoding="utf-8"))


def scene_of(rng: Random) -> dict[str, Any]:
    """Return a scene that follows the schema, in 2D or in 3D."""
    return {**_table(_resolved(schema()), rng, 0), "constants": {"a": 1.0, "b": "a*t"}}


def revised(scene: dict[str, Any], rng: Random) -> dict[str, Any]:
    """Return an example whose values are replaced by others that the schema allows in their places."""
    scene = json.loads(json.dumps(scene))
    for _ in range(rng.choice((1, 2, 3))):
        path = rng.choice(list(paths_of(scene)))
        node, table = schema(), scene
        for part in path[:-1]:
            node, table = _inner(node, part, rng), table[part]
        table[path[-1]] = value_of(_inner(node, path[-1], rng), rng, len(path))
    return scene


def value_of(node: Node, rng: Random, depth: int) -> Any:
    """Return a value that follows a node of the schema, mostly."""
    node = _resolved(node)
    if rng.random() < 0.01:
        return value_mutant(rng)
    for word in ("oneOf", "anyOf"):
        if word in node:
            return value_of(rng.choice(node[word]), rng, depth + 1)
    if "const" in node or "enum" in node:
        return rng.choice(node.get("enum", [node.get("const")]))
    match node.get("type"):
        case "object":
            return _table(node, rng, depth)
        case "array":
            low, high = node.get("minItems", 0), min(node.get("maxItems", 3), 6)
            items = node.get("prefixItems") or [node.get("items", {})]
            count = rng.choice((2, 2, 3)) if (low, high) == (2, 3) else rng.randint(min(low, high), high)
            return [value_of(items[k % len(items)], rng, depth + 1) for k in range(count)] if depth < 12 else []
        case "number" | "integer" as kind:
            return _number(node, rng, kind)
        case "boolean":
            return rng.random() < 0.5
        case "string":
            return rng.choice(TEXTS) if rng.random() < 0.1 else rng.choice(WORDS)
    return value_mutant(rng)


def _table(node: Node, rng: Random, depth: int) -> dict[str, Any]:
    required = node.get("required", [])
    often = 0.3 if depth < DEEPEST else 0.0
    found = {
        name: value_of(inner, rng, depth + 1)
        for name, inner in node.get("properties", {}).items()
        if (name in required and rng.random() < 0.99) or rng.random() < often
    }
    if isinstance(more := node.get("additionalProperties"), dict) and rng.random() < 0.5:
        found[rng.choice(WORDS)] = value_of(more, rng, depth + 1)
    return found


def _number(node: Node, rng: Random, kind: str) -> float:
    low = node.get("minimum", node.get("exclusiveMinimum", -10))
    high = node.get("maximum", node.get("exclusiveMaximum", max(low, 0) + 100))
    choice = rng.random()
    if choice < 0.1:
        return rng.choice(NUMBERS)
    if choice < 0.25:
        return rng.choice((low, high))
    return (
        rng.randint(int(low), int(min(high, low + 100))) if kind == "integer" else rng.uniform(low, min(high, low + 10))
    )


def _resolved(node: Node) -> Node:
    while "$ref" in node:
        node = schema()["$defs"][node["$ref"].rpartition("/")[2]]
    return node


def _inner(node: Node, part: str | int, rng: Random) -> Node:
    """Return the node of a key or an entry of a list; one that allows anything where the schema knows none."""
    node = _resolved(node)
    for inner in (*node.get("oneOf", ()), *node.get("anyOf", ())):
        found = _inner(inner, part, rng)
        if found:
            return found
    if isinstance(part, int):
        return node.get("items", {})
    found = node.get("properties", {}).get(part) or node.get("additionalProperties")
    return found if isinstance(found, dict) else {}
