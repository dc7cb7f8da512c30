"""The learned average: Robust Average blocks, kernel prediction, losses, training."""
