"""How compiled loops run."""
