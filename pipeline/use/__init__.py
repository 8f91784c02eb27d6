"""What a trained model is for: ask, describe, match, remember, adapt, read a camera, serve, demo.

In: a folder in models/, which the stage `package` writes, or the shipped one, which the stage `evaluate` asks.
"""
