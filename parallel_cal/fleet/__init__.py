"""Many robots: each recording fitted and diagnosed on many cores, and what only many can tell."""
