"""The tables and figures of the thesis and the paper again: `python -m bench.documents.tables`.

For each group of tables one file computes `numbers`, which docs/tables.json keeps, and a page
writes them into a `section` beside the printed ones.
"""
