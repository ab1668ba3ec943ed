"""`new_model` for tests: models of one mechanism of the shelf share what is derived from it.

The equations, derivatives and compiled functions of a model belong to its mechanism. Every
`load_mechanism` is a mechanism of its own, so that each test would derive them again, which is a
third of the time of a fit. A test that changes a mechanism needs the package's own `new_model`.
"""

from functools import cache

from parallel_cal.model import model as package
from parallel_cal.model.shelf import load_mechanism


def _state(mechanism):
    """Names and identities of what is stated about a mechanism, without what was derived since."""
    derived = type(mechanism).__mro__
    return {
        key: id(value)
        for key, value in vars(mechanism).items()
        if not any(hasattr(vars(cls).get(key), "func") for cls in derived)
    }


@cache
def shared(name):
    """A mechanism of the shelf, and its state when it was loaded."""
    mechanism = load_mechanism(name)
    return mechanism, _state(mechanism)


def new_model(mechanism, *arguments, **options):
    """What `parallel_cal.new_model` returns; a mechanism that is given by name is shared."""
    if isinstance(mechanism, str):
        name = mechanism
        mechanism, state = shared(name)
        assert _state(mechanism) == state, f"a test has changed the {name} that others share"
    return package.new_model(mechanism, *arguments, **options)
