"""Teach a language model the sense of touch: the system of Octopi (RSS 2024) as a DVC pipeline."""
