"""Methods that the documents compare: the shelf identification.methods goes on here."""
