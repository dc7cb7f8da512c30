"""Where did this pixel come from? Motion vectors, TV-L1 refinement, warping, confidence."""
