"""A local page that plays sequences side by side, also while they are being written."""
