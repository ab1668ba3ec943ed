"""Samples in messages: by their numbers, and by the names that their owner gave them."""

from __future__ import annotations


def format_sample(number: int, name: str = "") -> str:
    """Format a sample as `40`, or as `40 'S041'` if it has a name."""
    return f"{number} '{name}'" if name else str(number)
