"""Teaching a small language model to reason about described things, before it feels anything.

A model of Vicuna's size brings that reasoning; one of a hundred million parameters must be taught it. The text is made
up: its objects have invented names, its questions are worded otherwise than the tasks', so that what LoRA and OPD bring
can still be measured.
"""
