"""Finding phrases in free text: whole words, whatever their case and whether spaces or hyphens stand between them."""

from __future__ import annotations

import re
from collections.abc import Iterable


def plain(text: str) -> str:
    """In small letters, with one space wherever spaces, line breaks or hyphens stood."""
    return " ".join(re.split(r"[\s-]+", text.lower()))


def mentioned(text: str, phrases: Iterable[str]) -> list[str]:
    """The phrases (as `plain` writes them) that a text holds, longest first.

    Each stretch of text counts once, for the longest phrase: "no roughness" is not also "roughness", and "moderately
    hard" not also "hard", whatever stands between its words.
    """
    rest, found = plain(text), []
    for phrase in sorted(set(map(plain, phrases)), key=lambda p: (-len(p), p)):
        rest, times = re.subn(rf"(?<!\w){re.escape(phrase)}(?!\w)", "|", rest)
        found += [phrase] if times else []
    return found
