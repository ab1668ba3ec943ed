"""What a model can be exported to, one target a file; the file's name is the target's name."""
