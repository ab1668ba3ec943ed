"""What surrounds an identification: what it may be asked, and what is to be doubted."""
