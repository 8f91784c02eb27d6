"""Tiny base models, trained from scratch on generated data, so that the chain runs without a download."""
