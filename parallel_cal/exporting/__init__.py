"""The calibrated model as others compute it: controllers, tables, files of other tools."""
