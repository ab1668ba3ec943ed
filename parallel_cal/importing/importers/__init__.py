"""The shelf of importers: one controller a file, its name the file's own."""
