"""Episodes of a LeRobot dataset (layouts v3.0 and v2.1, read without its package) as videos that the chain reads."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import pandas as pd

from pipeline.core.io import remove_rests, write_csv
from pipeline.running.errors import UserError, did_you_mean
from pipeline.videos.catalogue.csv_reader import read_rows
from pipeline.videos.decoding import CONTAINERS, video_stream
from pipeline.videos.files import LIST_FILE
from pipeline.videos.importing.presses import NothingTouchesError, Recorded, Shot, cut, film, first_free

log = logging.getLogger(__name__)

VERSIONS = ("v2.1", "v3.0")
PLACE = ("chunk_index", "file_index", "from_timestamp")
"""Where v3.0 keeps an episode's video; the numbers of a file's folder and of the file, and seconds in it."""
REORDERED = 16
"""Frames that H.264 and HEVC store before one that is shown earlier, at most."""


class Imported(Recorded):
    """A row of the `videos.csv` beside imported episodes."""

    video: str
    """The camera's key in the dataset."""


@dataclass(frozen=True)
class Episode:
    """Where the frames of an episode lie in a video, and what it is called."""

    number: int
    task: str
    session: str
    """Dataset, episode, and its seconds in the video: the same for all presses and cameras of an episode."""
    file: Path
    first: int
    """Position in the file of the episode's first frame."""
    length: int
    """Number of frames."""
    fps: float


def import_episodes(
    root: Path, key: str, out: Path, objects: Path | None, times: float, *, pressed: bool
) -> list[Path]:
    """Write each episode's video as `<object_id>_<n>.mp4`, with a `videos.csv`; a second call goes on in it.

    A video is copied without being encoded anew where no frame outside of the episode comes along, else cut.

    Args:
        root: The dataset's folder.
        key: The video's key in `meta/info.json`.
        objects: CSV with `object_id` beside `episode` (a number) or `task`: names of the objects. Episodes that it
            lacks are left out. Without it an object is called as the episode's task.
        times: A press begins at this many times the quiet level.
        pressed: Write each press as a video, with a CSV of times from the episode's beginning (`cut`).

    Raises:
        UserError: if the dataset is incomplete or of another layout, or a name is unusable.
    """
    found = read_episodes(root, key)
    names = _object_ids(root, found, objects)
    listed, fields = out / LIST_FILE, list(Imported.model_fields)
    rows = (
        [Imported(**{f: row[f] for f in fields}) for _, row in read_rows(listed, fields)[1]] if listed.exists() else []
    )
    known = {row.session for row in rows if row.video == key}
    wanted = [episode for episode in found if episode.number in names]
    new = [episode for episode in wanted if episode.session not in known]
    if len(new) < len(wanted):
        log.warning("%s: lists %d of %d episodes, which stay as they are", listed, len(wanted) - len(new), len(wanted))
    out.mkdir(parents=True, exist_ok=True)
    remove_rests(out)
    written = list[Path]()
    for episode in new:
        object_id = names[episode.number]
        try:
            videos = _write(episode, out, object_id, times, pressed)
        except NothingTouchesError as problem:
            log.warning("%s; this episode is left out", problem)
            continue
        written += videos
        rows += [Imported(file=v.name, object_id=object_id, session=episode.session, video=key) for v in videos]
        write_csv(listed, Imported, rows)
    return written


def read_episodes(root: Path, key: str) -> list[Episode]:
    """The episodes of a dataset, in order, with their places in the videos of a camera."""
    file = root / "meta/info.json"
    if not file.is_file():
        raise UserError(f"{root}: no LeRobot dataset, as it lacks meta/info.json; name the folder that holds meta/")
    try:
        info = json.loads(file.read_text(encoding="utf-8"))
        version, fps, total = info["codebase_version"], float(info["fps"]), info["total_episodes"]
        if version not in VERSIONS:
            raise UserError(f"{file}: codebase_version {version}; convert it with LeRobot to {' or '.join(VERSIONS)}")
        keys = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
        if key not in keys:
            raise UserError(f"{file}: no video {key}; {did_you_mean(key, keys)}its videos: {', '.join(keys) or 'none'}")
        rows = list[dict[str, Any]]()
        if version == "v3.0":
            columns = ["episode_index", "tasks", "length", *(f"videos/{key}/{name}" for name in PLACE)]
            for file in sorted(root.glob("meta/episodes/*/*.parquet")):
                rows += pd.read_parquet(file, columns=columns).to_dict("records")
        else:
            file = root / "meta/episodes.jsonl"
            rows += map(json.loads, file.read_text(encoding="utf-8").splitlines())
        if len(rows) != total:
            raise UserError(f"{root}/meta: {len(rows)} of {total} episodes are listed; download the dataset again")
        found = []
        for row in sorted(rows, key=lambda row: row["episode_index"]):
            number, length = row["episode_index"], row["length"]
            chunk, index, begin = (row.get(f"videos/{key}/{name}", 0) for name in PLACE)
            video = info["video_path"].format(
                video_key=key,
                chunk_index=chunk,
                file_index=index,
                episode_chunk=number // info["chunks_size"],
                episode_index=number,
            )
            session = f"{root.resolve().name} episode {number} ({begin:.3f} to {begin + length / fps:.3f} s)"
            # Times are running sums, which comparing would take a frame too many or too few by.
            first = round(begin * fps)
            found.append(Episode(number, " ".join(row["tasks"]).strip(), session, root / video, first, length, fps))
    except FileNotFoundError:
        raise UserError(f"{file}: is missing; download the dataset again") from None
    except (AttributeError, LookupError, TypeError, ValueError) as problem:  # What JSON, pandas and a wrong key raise.
        reason = " ".join(str(problem).split())
        raise UserError(f"{file}: not as LeRobot writes it ({reason}); download the dataset again") from None
    return found


def _object_ids(root: Path, found: Sequence[Episode], table: Path | None) -> dict[int, str]:
    """The object's id of each episode that is wanted, by number."""
    ids = dict[int, str]()
    if table is None:
        ids = {episode.number: re.sub(r"\W+", "_", episode.task.lower()).strip("_") for episode in found}
    else:
        header, rows = read_rows(table, ("object_id",))
        column = "episode" if "episode" in header else "task"
        if column not in header:
            raise UserError(f"{table}: column episode or task is missing; add one of them")
        for where, row in rows:
            named = [e.number for e in found if row[column] == (e.task if column == "task" else str(e.number))]
            if not named:
                raise UserError(f"{where}: {root} has no {column} {row[column]!r}; correct the line or remove it")
            ids |= dict.fromkeys(named, row["object_id"])
        if len(ids) < len(found):
            log.warning("%s: lacks %d of %d episodes, which are left out", table, len(found) - len(ids), len(found))
    for number, object_id in ids.items():
        if re.fullmatch(r"[\w-]+", object_id) is None:
            wanted = "letters, digits, _ and -; say another with --objects"
            raise UserError(f"{table or root}: episode {number} has object {object_id!r}; take {wanted}")
    return ids


def _write(episode: Episode, out: Path, object_id: str, times: float, pressed: bool) -> list[Path]:
    part = out / f".episode.{os.getpid()}.part.mp4"
    try:
        before, exact = _copy(episode, part)
        if not pressed and exact:
            path = out / f"{object_id}_{first_free(out, object_id)}.mp4"
            os.replace(part, path)
            return [path]
        name = f"{episode.file}, episode {episode.number}"
        return cut(lambda: _shots(part, before, episode), name, out, object_id, times, whole=not pressed)
    finally:
        part.unlink(missing_ok=True)


def _copy(episode: Episode, part: Path) -> tuple[int, bool]:
    """Copy an episode's packets, from the last frame before it that is coded alone.

    Returns:
        Frames that stand before it in the copy, and whether the copy has its frames and no others.
    """
    held = list[tuple[int, Any]]()
    wanted = set(range(episode.first, episode.first + episode.length))
    try:
        with av.open(f"file:{episode.file}", options=CONTAINERS) as source:
            stream = video_stream(source)
            source.seek(round(max(0, episode.first - REORDERED) / episode.fps * av.time_base))
            for packet in source.demux(stream):
                if packet.pts is None or packet.is_corrupt:
                    continue
                number = round(float(packet.pts * packet.time_base) * episode.fps)
                if packet.is_keyframe and number <= episode.first:
                    held = []
                held.append((number, packet))
                wanted.discard(number)
                if not wanted:
                    break
            if wanted:
                lacking = f"lacks {len(wanted)} of {episode.length} frames of episode {episode.number}"
                raise UserError(f"{episode.file}: {lacking}; download the dataset again")
            begin, start = held[0][0], held[0][1].pts
            # Frames that are stored behind it but shown before it are coded as changes to what is not copied.
            held = [(number, packet) for number, packet in held if number >= begin]
            with av.open(f"file:{part}", "w", options={"fflags": "+bitexact"}) as copy:
                # Opaque, since an encoder of the codec is neither needed nor always there.
                to = copy.add_stream_from_template(stream, opaque=True)
                for _, packet in held:
                    packet.pts, packet.dts, packet.stream = packet.pts - start, packet.dts - start, to
                    copy.mux(packet)
    except FileNotFoundError:
        raise UserError(f"{episode.file}: is missing; download the dataset again") from None
    except (av.FFmpegError, ValueError) as problem:
        raise UserError(f"{episode.file}: no whole video ({problem}); download the dataset again") from None
    return episode.first - begin, len(held) == episode.length


def _shots(part: Path, before: int, episode: Episode) -> Iterator[Shot]:
    """The pictures of an episode at their times from its beginning, of a copy in which so many others stand before."""
    begin, end = ((place - 0.5) / episode.fps for place in (before, before + episode.length))
    late = round(1e9 * before / episode.fps)
    for shot in film(part, 0.0, begin, end):
        yield Shot(shot.picture, shot.recorded - late, shot.stamped - late)
