"""What a design and a plan are worth, before anything is built or measured."""
