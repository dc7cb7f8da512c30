"""Compiled loops on all cores."""
