"""Ask a trained model about two touches: `python examples/ask.py [VIDEO VIDEO [MODEL]]`; by default the shipped one."""

import sys
from pathlib import Path

from pipeline import Octopi

if len(sys.argv) == 2:
    sys.exit("name two videos")
here = Path(__file__).parent
first, second = sys.argv[1:3] if len(sys.argv) > 2 else (here / "soft.mp4", here / "hard.mp4")
folder = sys.argv[3] if len(sys.argv) > 3 else None

model = Octopi.from_pretrained(folder)
for piece in model.stream("Is the object in {tactile} softer than the object in {tactile}?", [first, second]):
    print(piece, end="", flush=True)
print()
for video in (first, second):
    described = model.describe(video)
    print(video)
    for name, probabilities in described.probabilities.items():
        known = ", ".join(f"{level} {model.config.share(p)}" for level, p in probabilities.items())
        print(f"  {name}: {described.levels[name]} ({known})")
    for note in described.notes:
        print(f"  {note}")
