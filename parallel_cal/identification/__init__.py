"""From samples to parameters: least squares on the closure, and how far to trust it."""
