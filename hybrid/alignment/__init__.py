"""Frames made safe to filter, and windows of them aligned to their centre."""
