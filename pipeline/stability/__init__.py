"""Hard cases of every part, in every number format that the part runs in: finite or not, and how far from float64.

One small module a part lists its cases; `run` judges them, the stage `stability` and the tests run the same ones.
"""
