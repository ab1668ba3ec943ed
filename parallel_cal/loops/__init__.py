"""Loops of a Delta's own arms and rods: the short-cut set-up."""
