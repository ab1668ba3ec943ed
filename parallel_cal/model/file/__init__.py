"""The YAML model file: text with lines, schema, checks, reading and writing."""
