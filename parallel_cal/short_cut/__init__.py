"""The short-cut set-up: a Delta identified from loops of its own arms and rods."""
