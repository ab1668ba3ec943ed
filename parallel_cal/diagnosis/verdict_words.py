"""What people read instead of the word of a verdict. It needs no NumPy, so that the page can use
it."""

from __future__ import annotations

# `explained` is an error that found effects describe: the model lacks them.
VERDICT_LABELS = {
    "at_noise": "at the noise floor",
    "explained": "explained, not yet in the model",
    "partly_explained": "partly explained, not yet in the model",
    "unexplained": "unexplained",
    "cannot_know": "cannot know",
}


def describe_verdict(word: str, summary: str) -> str:
    """Write `explained, not yet in the model: backlash accounts for ...`; empty without a word."""
    return f"{VERDICT_LABELS[word]}: {summary}" if word else ""
