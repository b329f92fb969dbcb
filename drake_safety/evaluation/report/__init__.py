"""The report of a run: an HTML page, and tables as CSV, JSON and Markdown."""
