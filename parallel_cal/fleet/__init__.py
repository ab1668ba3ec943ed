"""Analyse many robots: fit and diagnose each recording in parallel, then compare the robots."""
