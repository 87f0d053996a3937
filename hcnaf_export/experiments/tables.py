"""Markdown of results."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table; columns that are empty throughout are left out."""
    kept = [k for k, title in enumerate(head) if title or any(row[k] for row in rows)]
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(line[k] for k in kept) + " |" for line in lines]
