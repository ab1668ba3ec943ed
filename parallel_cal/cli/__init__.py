"""What the commands of `parallel-cal` do, and how people and programs see their answers."""
