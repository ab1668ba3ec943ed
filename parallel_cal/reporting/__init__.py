"""Reports and pages: the parts of the documents, their figures, tables and texts."""
