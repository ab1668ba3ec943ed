"""Algorithms for the direct and inverse problem."""
