"""Errors as a person reads them."""

UNITS = (  # kind, factor from SI, unit
    ("position", 1e6, "um"),
    ("orientation", 3437.75, "arcmin"),
    ("reading", 1e6, "um"),
)
