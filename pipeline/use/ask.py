"""Asking a trained model in a terminal: one question, a chat, or a description of every video of a folder."""

from __future__ import annotations

import csv
import io
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rich.markup import escape
from rich.table import Column, Table

from pipeline.core.io import sha256, write_text
from pipeline.running.errors import UserError, readable
from pipeline.running.progress import progress
from pipeline.use.results import Exchange, Video
from pipeline.videos.decoding import SUFFIXES
from pipeline.videos.files import video_files

if TYPE_CHECKING:
    import pandas as pd

    from pipeline.use.model import Octopi

log = logging.getLogger(__name__)

BATCH = 8
"""Videos that are described at once; a killed description loses no more."""
PROMPT = "> "
HELP = """\
/add FILE  take a video for the next question; {tactile} says where, or it stands in front
/frames    what the model sees of the videos
/reset     begin a new conversation
/quit      end"""


def answer_once(model: Octopi, question: str, videos: Sequence[str]) -> dict[str, Any]:
    """An answer with what it stands on, for machines."""
    answer, heads = model.ask(question, videos), model.verdict(question, videos)
    return {
        "notes": (*model.apart(answer, heads), *model.doubts_about(question, len(videos))),
        "model": model.name,
        "question": question,
        "videos": [
            {"file": video, "frames": touch.numbers, "contact": touch.contact, "notes": touch.notes} | classes
            for video, touch, classes in zip(videos, map(model.look, videos), classes_of(model, videos), strict=True)
        ],
        "answer": answer,
        "heads": heads.shown if heads else "",
    }


def classes_of(model: Octopi, videos: Sequence[Video]) -> list[dict[str, Any]]:
    """For machines, what the property heads say of each video; nothing where there are none."""
    if not model.config.heads:
        return [{} for _ in videos]
    wanted = {"levels", "probabilities", "calibrated"}
    return [model.describe(video, sentence=False).model_dump(include=wanted) for video in videos]


def lines_of_terminal() -> Iterator[str]:
    """What a person types, line by line, until the end of input."""
    with suppress(ImportError):
        import readline  # noqa: F401  (gives `input` a history and editing keys)
    while True:
        try:
            yield input(PROMPT)
        except EOFError:
            return
        except KeyboardInterrupt:
            print("\n(/quit ends)")


class Chat:
    """A conversation: questions, and commands that begin with a slash.

    Args:
        say: Shows a piece of text; no line end is added.
    """

    def __init__(self, model: Octopi, say: Callable[[str], object]) -> None:
        self.model, self.say = model, say
        self.history: list[Exchange] = []
        self.waiting: list[Video] = []
        self.added: dict[str, str] = {}
        """Files that were added, and the hash of what they held then."""

    @property
    def videos(self) -> list[Video]:
        """Those of the conversation, and those that wait for the next question."""
        return [*(v for exchange in self.history for v in exchange.videos), *self.waiting]

    def run(self, lines: Iterable[str]) -> None:
        """Answer line by line; what is wrong is said, and the conversation goes on."""
        for doubt in self.model.doubts:
            self.say(f"note: {doubt}\n")
        for line in map(str.strip, lines):
            if line == "/quit":
                return
            try:
                if line.startswith("/"):
                    self._command(*line.partition(" ")[::2])
                elif line:
                    self._ask(line)
            except UserError as error:
                self.say(f"{error}\n")
            except KeyboardInterrupt:
                self.say("\n(stopped; the question is forgotten)\n")

    def _command(self, name: str, rest: str) -> None:
        match name:
            case "/add" if file := rest.strip():
                touch = self.model.touched(file).touch  # Refused here, and not at each question from now on.
                self.added.setdefault(file, digest(Path(file)))
                self._check_files()
                self.waiting.append(file)
                self.say("".join(f"{file}: {note}\n" for note in touch.notes))
                many = len(self.waiting)
                self.say(f"{many} for the next question: {{tactile}} once for each, or they stand in front\n")
            case "/frames":
                for video in self.videos:
                    touch = self.model.look(video)
                    numbers = ", ".join(map(str, touch.numbers))
                    self.say(f"{video}: frames {numbers}; touched {touch.contact:.0%} of the picture\n")
                    self.say("".join(f"  {note}\n" for note in touch.notes))
                if not self.videos:
                    self.say("no video yet: /add FILE\n")
            case "/reset":
                self.history, self.waiting, self.added = [], [], {}
                self.say("a new conversation\n")
            case _:
                self.say(f"{HELP}\n")

    def _check_files(self) -> None:
        """Raise UserError where a file was recorded anew or is gone: earlier answers are about what it held before."""
        for file, held in self.added.items():
            if not (now := digest(Path(file))):
                raise UserError(f"{file} is gone since it was added; put it back, or /reset")
            if now != held:
                raise UserError(f"{file} has changed since it was added; name the new one otherwise, or /reset")

    def _ask(self, question: str) -> None:
        self._check_files()
        said = ""
        for piece in self.model.stream(question, self.waiting, history=self.history):
            self.say(piece)
            said += piece
        heads = self.model.verdict(question, self.waiting)
        self.say(f"\n(property heads: {heads.shown})\n" if heads else "\n")
        notes = (*self.model.apart(said, heads), *self.model.doubts_about(question, len(self.videos)))
        self.say("".join(f"note: {note}\n" for note in notes if note not in self.model.doubts))
        self.history.append(Exchange(question, tuple(self.waiting), said))
        self.waiting = []


def digest(file: Path) -> str:
    """The SHA-256 of a file; empty where it cannot be read, which the model then says in its own words."""
    try:
        return sha256(file)
    except OSError:
        return ""


def named_objects(text: str) -> list[str] | dict[str, list[str]]:
    """What `--names` says: "NAME, NAME" of a catalogue, or names with classes, "NAME: CLASS, CLASS; NAME: ..."."""
    if ":" not in text:
        return [name.strip() for name in re.split("[,;]", text) if name.strip()]
    told = [part.partition(":") for part in text.split(";") if part.strip()]
    return {name.strip(): [c.strip() for c in classes.split(",")] for name, _, classes in told}


def describe_folder(model: Octopi, paths: Sequence[Path], out: Path) -> tuple[int, int]:
    """Describe videos, and every one of folders and their subfolders, in a CSV file, a row each; a second call goes on.

    Returns:
        How many rows the file has, and how many of them are videos that could not be described (column `error`).

    Raises:
        UserError: for a folder without videos, or a file that another model or something else wrote, or that describes
            another recording under the name of one of these.
    """
    files, (columns, label) = videos_of(paths), _columns(model)
    csv.writer(head := io.StringIO(), lineterminator="\n").writerow(columns)
    # A kill may have cut a character in two; a file that was sent may have others.
    text = out.read_text(encoding="utf-8", errors="replace") if out.is_file() else ""
    whole, begun = text[: text.rfind("\n") + 1], head.getvalue()
    rows = list(csv.DictReader(io.StringIO(whole)))
    if not (text.startswith(begun) or begun.startswith(text)) or any(row["model"] != label for row in rows):
        raise UserError(f"{out}: is no description by {label}; name another file with --csv")
    known, hashes = {row["file"]: row["sha256"] for row in rows}, {name: digest(file) for file, name in files}
    if other := next((name for name, held in hashes.items() if known.get(name, held) != held), None):
        raise UserError(
            f"{out}: describes another recording as {other}; delete its row, or name another file with --csv"
        )
    write_text(out, whole or begun)  # Without what a kill left of a last line.
    done = {row["file"]: row["error"] for row in rows}
    rest = [(file, name) for file, name in files if name not in done]
    failed = sum(bool(error) for error in done.values())
    with (
        progress(len(rest), "describe", "video") as advance,
        out.open("a", encoding="utf-8", errors="backslashreplace", newline="") as stream,
    ):
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        for row in _describe(model, rest):
            writer.writerow({**row, "sha256": hashes[str(row["file"])], "model": label})
            stream.flush()
            failed += bool(row.get("error"))
            advance()
    return len(done) + len(rest), failed


def table(model: Octopi, paths: Sequence[Path]) -> pd.DataFrame:
    """As `describe_folder`, in memory."""
    import pandas as pd

    files, (columns, label) = videos_of(paths), _columns(model)
    rows = zip(files, _describe(model, files), strict=True)
    return pd.DataFrame([{**row, "sha256": digest(file), "model": label} for (file, _), row in rows], columns=columns)


def _columns(model: Octopi) -> tuple[list[str], str]:
    """Columns of a description, and what the last one says of the model."""
    probabilities = [f"{p.name}: {level}" for p in model.catalogue.properties for level in p.levels]
    columns = ["file", "sha256", *model.properties, *probabilities, "sentence", "frames", "notes", "error", "model"]
    return columns, f"{model.name} {model.config.digest}"


def described(model: Octopi, paths: Sequence[Path]) -> tuple[Table, list[str]]:
    """A table for a terminal, of videos and all those of folders: each class with its probability, and the sentence.

    Returns:
        The table, and what should make one doubt it: notes, and errors of videos that could not be described.

    Raises:
        UserError: the first video's error, where none could be described.
    """
    files = videos_of(paths)
    # The beginning of a path tells nobody which video it is; that of several of one name has to.
    named = Counter(file.name for file, _ in files)
    files = [(file, name if named[file.name] > 1 else readable(file.name)) for file, name in files]
    # Folded, since names that are cut may be those of several files.
    table = Table(*(Column(name, overflow="fold") for name in ("video", *model.properties, "in words")))
    notes, errors = [*model.doubts], list[str]()
    for row in _describe(model, files):
        found = [(row.get(p), cast("float", row.get(f"{p}: {row.get(p)}", 0.0))) for p in model.properties]
        cells = [f"{level} ({model.config.share(p)})" if p else str(level or "") for level, p in found]
        table.add_row(*map(escape, (str(row["file"]), *cells, str(row.get("sentence", "")))))
        notes += [f"{row['file']}: {row['notes']}"] if row.get("notes") else []
        errors += [str(row["error"])] if row.get("error") else []
    if len(errors) == len(files):
        raise UserError(f"{errors[0]}{f' (nor was any of {len(errors) - 1} more described)' if errors[1:] else ''}")
    return table, [*errors, *notes]


def videos_of(paths: Sequence[Path]) -> list[tuple[Path, str]]:
    """The videos that paths name, each as a row calls it: from the one folder that is named, else by its whole path."""
    found: list[tuple[Path, str]] = []
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: no such file or folder; name a video, or a folder of videos")
        files, findings = ([path], []) if path.is_file() else video_files(path)
        for finding in findings:
            log.warning("%s: %s", finding.item, finding.measured)
        if not files:
            raise UserError(f"{path}: holds no video ({', '.join(SUFFIXES)}); name another folder")
        start = path.parent if path.is_file() else path
        named = files if paths[1:] else [file.relative_to(start) for file in files]
        found += zip(files, [readable(name.as_posix()) for name in named], strict=True)
    return found


def _describe(model: Octopi, files: Sequence[tuple[Path, str]]) -> Iterator[dict[str, object]]:
    """A row for each video: its description, or the error that says why there is none."""
    for start in range(0, len(files), BATCH):
        rows: list[dict[str, object]] = []
        good = []
        for file, name in files[start : start + BATCH]:
            row: dict[str, object] = {"file": name}
            rows.append(row)
            try:
                model.look(file)
                good.append((file, row))
            except UserError as error:
                row["error"] = " ".join(str(error).split())
        for (_, row), found in zip(good, model.describe_all([file for file, _ in good]), strict=True):
            row |= found.levels
            for name, known in found.probabilities.items():
                row |= {f"{name}: {level}": round(p, 4) for level, p in known.items()}
            row |= {"sentence": " ".join(found.sentence.split()), "frames": " ".join(map(str, found.frames))}
            row["notes"] = "; ".join(note for note in found.notes if note not in model.doubts)
        yield from rows
