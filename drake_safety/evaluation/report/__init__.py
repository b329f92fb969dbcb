"""The report of a run: one HTML page for somebody who has not read the paper, tables, README."""
