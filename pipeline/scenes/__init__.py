"""Synthetic GelSight videos: geometry, contact, light, video, and a recipe for each object."""
