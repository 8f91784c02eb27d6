"""The page as HTML in one file: styles, drawings and pictures inside it, no script, and nothing fetched.

`octopi page` writes it, and `make repro` ends with that. It is no output of a DVC stage: it spans the reports of all
scales, while a stage knows one, and DVC deletes a stage's outputs before it runs; and as a stage of its own it would
have to name folders that another scale has not made yet. It holds no date and reads nothing but reports/ and dvc.yaml,
so equal input gives equal bytes, and a test tells whether the page in Git is that of the reports beside it.
"""

from __future__ import annotations

import base64
import hashlib
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from pipeline.io import write_text
from pipeline.errors import UserError
from pipeline.review.graph import HEIGHT, WIDTH
from pipeline.review.page import Page, compose, strip_file
from pipeline.review.tables import BAR_WIDTH

PAGE = Path("reports") / "index.html"
TEMPLATE, STYLE = "page.html", "style.css"
LOSSLESS = 101
"""OpenCV's WebP quality above 100."""


def write_page(root: Path) -> Path:
    """Write reports/index.html below `root`.

    Raises:
        UserError: where there is no report yet.
    """
    if not (root / "reports").is_dir():
        raise UserError("reports: no such folder; `make repro` makes the first report")
    page = compose(root)
    if not page.chapters:
        raise UserError("reports: no report yet; `make repro` makes one")
    write_text(root / PAGE, render(page, root / "reports"))
    return root / PAGE


def render(page: Page, reports: Path) -> str:
    """The page's HTML; pictures are read from `reports`."""
    environment = Environment(
        loader=PackageLoader("pipeline.review"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["inline"] = inline
    environment.filters["anchor"] = anchor
    environment.globals |= {
        "picture": partial(picture, reports),
        "pixels": partial(pixels, reports),
        "strip_file": strip_file,
        "bar_width": BAR_WIDTH,
        "box": (WIDTH, HEIGHT),
    }
    source, _, _ = environment.loader.get_source(environment, STYLE) if environment.loader else ("", None, None)
    style = "\n" + source
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    return environment.get_template(TEMPLATE).render(page=page, style=Markup(style), style_hash=digest)


def inline(text: str) -> Markup:
    """The little Markdown that captions have: code, strong and emphasis."""
    marked = str(escape(text))
    for mark, tag in ((r"`([^`]+)`", "code"), (r"\*\*([^*]+)\*\*", "strong"), (r"\*([^*]+)\*", "em")):
        marked = re.sub(mark, rf"<{tag}>\1</{tag}>", marked)
    return Markup(marked)


def anchor(text: str) -> str:
    """A name for links."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def picture(reports: Path, file: str) -> str:
    """A PNG as a data URI: as lossless WebP, which takes half the room."""
    pixels = cv2.imdecode(np.frombuffer(_bytes(reports, file), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise UserError(f"{reports / file}: no picture; run `dvc repro` at its scale")
    encoded = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS])[1]
    return f"data:image/webp;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def pixels(reports: Path, file: str) -> tuple[int, int]:
    """Width and height of a PNG, which stand at a fixed place in its head."""
    head = _bytes(reports, file)[16:24]
    return int.from_bytes(head[:4], "big"), int.from_bytes(head[4:], "big")


def _bytes(reports: Path, file: str) -> bytes:
    path = reports / file
    if not path.is_file():
        raise UserError(f"{path}: no such file, but its report names it; run `dvc repro` at its scale")
    return path.read_bytes()
