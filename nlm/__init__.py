"""Which pixels may be averaged? Robust average, variance, non-local means, guided filter."""
