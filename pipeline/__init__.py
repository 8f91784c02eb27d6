"""Teach a language model the sense of touch: the system of Octopi (RSS 2024) as a DVC pipeline."""

import os

# Read by OpenMP when torch loads. Its default lets waiting threads spin: on a busy machine, answering 57 questions on
# two threads then took 203 s in place of 9 s.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
