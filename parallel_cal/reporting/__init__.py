"""What a report is made of: the parts of its document, their figures and tables, the page."""
