"""Warnings with a key that stays the same while the numbers in their text change."""

from __future__ import annotations


class KeyedWarning(str):
    """The words of a warning, with a key: what `kind` of warning it is, and about which `subject`.

    The words are for people. Code that looks repeatedly compares `warning_key`, so that a growing
    count is not a new warning.

    Examples
    --------
    >>> from parallel_cal.base.keyed_warning import KeyedWarning, warning_key
    >>> warning = KeyedWarning("leg1: 12 messages lost", "lost", "leg1")
    >>> print(warning, warning_key(warning))
    leg1: 12 messages lost ('lost', 'leg1')
    """

    kind: str
    subject: str

    def __new__(cls, words: str, kind: str = "", subject: str = "") -> KeyedWarning:
        warning = super().__new__(cls, words)
        warning.kind, warning.subject = kind, subject
        return warning


def warning_key(warning: str) -> tuple[str, str]:
    """Return (kind, subject) of a warning; of one without a key (words, ""), as these words contain
    no numbers."""
    if isinstance(warning, KeyedWarning) and warning.kind:
        return warning.kind, warning.subject
    return str(warning), ""
