"""The targets of an export, one per file; the file's name is the target's name."""
