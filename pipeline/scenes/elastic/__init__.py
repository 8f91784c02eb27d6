"""Elastic contact without friction: what a pressure does to a surface, and which pressure a pressed body makes."""
