"""Discovery: find the law of an error that no effect of the catalogue describes."""
