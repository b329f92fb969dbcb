"""Evaluation of assessments: metrics with intervals, shifts, tables and figures."""
