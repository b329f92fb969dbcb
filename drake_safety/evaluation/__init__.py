"""Evaluation of assessments: metrics with intervals, baselines, studies, figures and the report."""
