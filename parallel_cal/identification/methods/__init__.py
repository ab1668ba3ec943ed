"""Identification methods."""
