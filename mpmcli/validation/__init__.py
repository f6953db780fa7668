"""Validation: cases with known solutions, their runs, verdicts and report."""
