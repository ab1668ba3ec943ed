"""Warnings that are recognised again although the numbers in their words change."""

from __future__ import annotations


class KeyedWarning(str):
    """The words of a warning, with a key: what `kind` of warning it is, and about which `subject`.

    Words are for people. Whoever looks repeatedly compares `warning_key`, so that a count that
    grows makes no new warning.

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
    """(kind, subject) of a warning; of one without a key its words, which hold no numbers."""
    if isinstance(warning, KeyedWarning) and warning.kind:
        return warning.kind, warning.subject
    return str(warning), ""
