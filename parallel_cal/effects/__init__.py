"""One physical effect a file: the file name is the effect's public name."""
