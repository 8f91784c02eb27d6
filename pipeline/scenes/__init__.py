"""Synthetic GelSight videos: geometry, contact, light, motion, and a recipe for each object.

In: the catalogue's scenes.yaml, or a seed. Out: data/scenes (stage `synthesize`) and data/invented (`invent`). The
stage `pretrain` draws its pictures here.
"""
