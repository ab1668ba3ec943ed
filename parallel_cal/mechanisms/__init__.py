"""One mechanism a file: the file name is the mechanism's public name."""
