"""A local page that plays sequences, finished or still being made, beside each other."""
