"""Shots made with a real path tracer: what is in a scene, what that calls for, and the rendering itself."""
