"""Reading and writing: pixels and headers, layers, frames, sequences, whole or not at all."""
