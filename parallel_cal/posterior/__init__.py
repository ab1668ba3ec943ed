"""The posterior of every set of causes: blocks of columns, their evidence, and a search over sets."""
