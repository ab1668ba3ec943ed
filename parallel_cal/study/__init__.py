"""Evaluate a design and a measurement plan before anything is built or measured."""
