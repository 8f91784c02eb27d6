"""Presses cut out of long recordings, a robot's among them, as videos that the chain reads."""
