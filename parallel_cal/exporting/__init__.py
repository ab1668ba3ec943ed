"""Export the calibrated model to controllers, tables and files of other tools."""
