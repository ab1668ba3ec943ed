"""The commands of `parallel-cal` and their output for people and programs."""
