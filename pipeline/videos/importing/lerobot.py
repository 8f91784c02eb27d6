"""Episodes of a LeRobot dataset (layouts v3.0 and v2.1, read without its package) as videos that the chain reads."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import av
import pandas as pd

from pipeline.core.io import remove_rests
from pipeline.running.errors import UserError, counted, did_you_mean
from pipeline.videos.catalogue.csv_reader import check_object_id, read_rows
from pipeline.videos.decoding import CONTAINERS, video_stream
from pipeline.videos.files import LIST_FILE, add_to_list
from pipeline.videos.importing.presses import NothingTouchesError, cut, film, first_free

log = logging.getLogger(__name__)

PLACE = ("chunk_index", "file_index", "from_timestamp")
"""Where v3.0 keeps an episode's video; the numbers of a file's folder and of the file, and seconds in it."""
REORDERED = 16
"""Frames that H.264 and HEVC store before one that is shown earlier, at most."""
AGAIN = "download the dataset again"


@dataclass(frozen=True)
class Episode:
    """Where the frames of an episode lie in a video, and what it is called."""

    number: int
    task: str
    session: str
    """Dataset, episode, and its seconds in the video: the same for all presses and cameras of an episode."""
    file: Path
    frames: range
    fps: float


def import_episodes(
    root: Path, key: str, out: Path, objects: Path | None, times: float, *, pressed: bool
) -> list[Path]:
    """Write each episode's video as `<object_id>_<n>.mp4`, with a `videos.csv`; a second call goes on in it.

    Its column `video` is the camera's key in the dataset.

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
    names, listed = _object_ids(root, found, objects), out / LIST_FILE
    lines = [row for _, row in read_rows(listed, ("file", "object_id"))[1]] if listed.exists() else []
    known = {row["session"] for row in lines if row.get("video") == key and "session" in row}
    if known:
        log.warning("%s: lists %s already; they stay as they are", listed, counted(len(known), "episode"))
    out.mkdir(parents=True, exist_ok=True)
    remove_rests(out)
    part, written = out / f".episode.{os.getpid()}.part.mp4", list[Path]()
    for episode in found:
        if episode.number not in names or episode.session in known:
            continue
        object_id = names[episode.number]
        try:
            if copy(episode, part) > len(episode.frames) or pressed:
                # Half a frame before the next one, so that rounded times take no frame too many.
                read = partial(film, part, end=(len(episode.frames) - 0.5) / episode.fps)
                name = f"{episode.file}, episode {episode.number}"
                videos = cut(read, name, out, object_id, times, whole=not pressed)
            else:
                videos = [part.replace(out / f"{object_id}_{first_free(out, object_id)}.mp4")]
        except NothingTouchesError as problem:
            log.warning("%s; this episode is left out", problem)
            continue
        finally:
            part.unlink(missing_ok=True)
        same = {"object_id": object_id, "session": episode.session, "video": key}
        add_to_list(out, [{"file": video.name} | same for video in videos])
        written += videos
    return written


def read_episodes(root: Path, key: str) -> list[Episode]:
    """The episodes of a dataset, in order, with their places in the videos of a camera."""
    file, rows, found = root / "meta/info.json", list[dict[str, Any]](), []
    try:
        info = json.loads(file.read_text(encoding="utf-8"))
        version, fps, total = info["codebase_version"], float(info["fps"]), info["total_episodes"]
        if version not in ("v2.1", "v3.0"):
            raise UserError(f"{file}: codebase_version {version}; convert it with LeRobot to v2.1 or v3.0")
        keys = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
        if key not in keys:
            raise UserError(f"{file}: no video {key}; {did_you_mean(key, keys)}its videos: {', '.join(keys) or 'none'}")
        if version == "v3.0":
            columns = ["episode_index", "tasks", "length", *(f"videos/{key}/{name}" for name in PLACE)]
            for file in sorted(root.glob("meta/episodes/*/*.parquet")):
                rows += pd.read_parquet(file, columns=columns).to_dict("records")
        else:
            file = root / "meta/episodes.jsonl"
            with file.open(encoding="utf-8") as stream:
                rows += map(json.loads, stream)
        if len(rows) != total:
            raise UserError(f"{root}/meta: {len(rows)} of {total} episodes are listed; {AGAIN}")
        for row in sorted(rows, key=lambda row: row["episode_index"]):
            number, length = row["episode_index"], row["length"]
            place = {name: row.get(f"videos/{key}/{name}", 0) for name in PLACE}
            place |= {"video_key": key, "episode_index": number, "episode_chunk": number // info["chunks_size"]}
            video, begin = root / info["video_path"].format(**place), place["from_timestamp"]
            name = "/".join(root.resolve().parts[-2:])  # USER/NAME, as LeRobot stores them.
            session = f"{name} episode {number} ({begin:.3f} to {begin + length / fps:.3f} s)"
            # Times are running sums, which comparing would take a frame too many or too few by.
            first = round(begin * fps)
            task = " ".join(row["tasks"]).strip()
            found.append(Episode(number, task, session, video, range(first, first + length), fps))
    except FileNotFoundError:
        raise UserError(f"{file}: is missing; name a LeRobot dataset's folder, or {AGAIN}") from None
    except (AttributeError, LookupError, TypeError, ValueError) as problem:  # What JSON, pandas and a wrong key raise.
        reason = " ".join(str(problem).split())
        raise UserError(f"{file}: not as LeRobot writes it ({reason}); {AGAIN}") from None
    return found


def _object_ids(root: Path, found: Sequence[Episode], table: Path | None) -> dict[int, str]:
    """The object's id of each episode that is wanted, by number."""
    ids = {episode.number: re.sub(r"\W+", "_", episode.task.lower()).strip("_") for episode in found}
    if table is not None:
        ids = {}
        header, rows = read_rows(table, ("object_id",))
        column = "episode" if "episode" in header else "task"
        if column not in header:
            raise UserError(f"{table}: column episode or task is missing; add one of them")
        for where, row in rows:
            named = [e.number for e in found if row[column] == (e.task if column == "task" else str(e.number))]
            if not named:
                raise UserError(f"{where}: {root} has no {column} {row[column]!r}; correct the line or remove it")
            if twice := ids.keys() & {*named}:
                raise UserError(f"{where}: episode {min(twice)} has an object already; remove one of its lines")
            ids |= dict.fromkeys(named, row["object_id"])
        if len(ids) < len(found):
            log.warning("%s: lacks %d of %d episodes, which are left out", table, len(found) - len(ids), len(found))
    for number, object_id in ids.items():
        check_object_id(f"{table or root}: episode {number}", object_id, "; name it in a CSV, with --objects")
    return ids


def copy(episode: Episode, part: Path) -> int:
    """Copy an episode's packets, and those before that decoding them takes, which no player shows; how many in all."""
    held, wanted = list[tuple[int, Any]](), set(episode.frames)
    try:
        with av.open(f"file:{episode.file}", options=CONTAINERS) as source:
            stream = video_stream(source)
            source.seek(round(max(0, episode.frames.start - REORDERED) / episode.fps * av.time_base))
            for packet in source.demux(stream):
                if packet.pts is None or packet.is_corrupt:
                    continue
                number = round(float(packet.pts * packet.time_base) * episode.fps)
                if packet.is_keyframe and number <= episode.frames.start:
                    held = []
                held.append((number, packet))
                wanted.discard(number)
                if not wanted:
                    break
            if wanted:
                lacking = f"lacks {len(wanted)} of {len(episode.frames)} frames of episode {episode.number}"
                raise UserError(f"{episode.file}: {lacking}; {AGAIN}")
            # Frames before it get negative times, which go into an edit list and are not shown.
            start = next(packet.pts for number, packet in held if number == episode.frames.start)
            with av.open(f"file:{part}", "w", options={"fflags": "+bitexact"}) as target:
                # Opaque, since an encoder of the codec is neither needed nor always there.
                to = target.add_stream_from_template(stream, opaque=True)
                for _, packet in held:
                    packet.pts, packet.dts, packet.stream = packet.pts - start, packet.dts - start, to
                    target.mux(packet)
    except FileNotFoundError:
        raise UserError(f"{episode.file}: is missing; {AGAIN}") from None
    except (av.FFmpegError, ValueError) as problem:
        raise UserError(f"{episode.file}: no whole video ({problem}); {AGAIN}") from None
    return len(held)
