"""What a fit leaves, its possible causes as blocks of columns, and how probable each cause is."""
