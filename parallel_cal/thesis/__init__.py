"""Solvers and methods of the documents that only their tables need; selected by name as others."""
