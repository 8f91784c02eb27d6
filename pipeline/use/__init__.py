"""What a trained model is for: ask, describe, match, remember, serve, demo.

In: a folder that the stage `package` wrote to models/, or the shipped one, which the stage `shipped` asks.
"""
