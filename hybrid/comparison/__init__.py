"""Accuracy against time: methods run, judged and shown side by side."""
