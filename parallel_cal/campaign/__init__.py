"""A robot that calibrates itself: where it goes, what it measures there, when that is enough."""
