"""The part that users touch: EXR files, shots, the plan, the pipeline, comparison, the command."""
