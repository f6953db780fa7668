"""Parsed TOML: copies of it, and how deep it may be."""

from typing import Any

# Lists and tables within one another. No scene needs a fifth of it, and Python's own stack ends at some hundreds.
MOST_NESTED = 60


def copied(tree: Any) -> Any:
    """Return a copy of tables and lists, in which no table is in two places, as callers in Python may have it."""
    if isinstance(tree, dict):
        return {key: copied(value) for key, value in tree.items()}
    return [copied(value) for value in tree] if isinstance(tree, list) else tree


def too_deep(tree: Any) -> bool:
    """Say whether tables and lists lie deeper within one another than MOST_NESTED."""
    level = [tree]
    for _ in range(MOST_NESTED):
        level = [
            inner
            for one in level
            if isinstance(one, dict | list)
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
        if not level:
            return False
    return True
