"""Which cases of a test run in every `make check`, and which are further ones of one kind."""

import pytest


def keep(cases, *kept):
    """Return cases for `parametrize`: those in `kept`, and the others for `make nightly` alone."""
    missing = [case for case in kept if case not in cases]
    if missing:
        raise ValueError(f"kept cases {missing} are none of {list(cases)}: state what is there")
    return [case if case in kept else as_slow(case) for case in cases]


def as_slow(case):
    """Return a case that only `make slow` and `make nightly` run."""
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=pytest.mark.slow)
