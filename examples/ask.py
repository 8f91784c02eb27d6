"""Ask a trained model about two touches: `python examples/ask.py [MODEL [VIDEO VIDEO]]`, after `make repro`."""

import sys
from pathlib import Path

from pipeline import Octopi

scenes = sorted(Path("data/scenes/videos").rglob("*.*"))
folder = sys.argv[1] if len(sys.argv) > 1 else "models/finetuned-with-all-0"
if len(sys.argv) == 3:
    sys.exit("name two videos")
first, second = sys.argv[2:4] if len(sys.argv) > 3 else (scenes[0], scenes[-1])

model = Octopi.from_pretrained(folder)
for piece in model.stream("Is the object in {tactile} softer than the object in {tactile}?", [first, second]):
    print(piece, end="", flush=True)
print()
for video in (first, second):
    described = model.describe(video)
    print(video)
    for name, known in described.probabilities.items():
        print(f"  {name}: {described.levels[name]} ({', '.join(f'{level} {p:.0%}' for level, p in known.items())})")
    for note in described.notes:
        print(f"  {note}")
