"""What the user touches: EXR files, shots, the plan, the pipeline, comparison, the command."""
