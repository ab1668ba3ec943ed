"""The calibrated model for others: controllers, tables, files of other tools."""
