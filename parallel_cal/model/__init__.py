"""A model: mechanism + effects + sensors + numbers, and the file that holds it."""
