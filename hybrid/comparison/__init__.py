"""Comparison of denoisers: accuracy against time, with a report."""
