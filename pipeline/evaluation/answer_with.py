"""Ask a vision-language model behind an OpenAI-compatible endpoint the evaluation questions.

In place of tactile videos it gets pictures. The paper compares with such a model, PG-InstructBLIP (Gao et al. 2024,
arXiv:2309.02561). Answers are written to `external/`, which the stages `grade` and `report` read: no stage asks a
network.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import Field, HttpUrl, TypeAdapter, ValidationError

from pipeline.config import Params
from pipeline.core.errors import UserError
from pipeline.core.io import fingerprint, read_jsonl, write_json, write_jsonl
from pipeline.core.records import Opd, Prediction, Question, Record, Shown, VisionModel
from pipeline.core.runtime import track
from pipeline.core.stage import DATA, alone
from pipeline.evaluation.grading import EXTERNAL, SOURCE_FILE
from pipeline.training.sampling import sample_evaluation
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.frames.store import FrameStore, frames_key

Show = Callable[[str], list[str]]
"""From a video's id to the pictures that stand for it, as data URLs."""

CACHE_FILE = "cache.jsonl"
PHOTO_SUFFIXES = (".jpeg", ".jpg", ".png", ".webp")
EXAMPLES = 3
"""Most training questions that stand before a question as examples (few-shot)."""
LONGEST = 1024
"""Pixels of a photo's longer side that are sent at most."""
FILTERS = ("content_filter", "content_policy_violation")
"""Codes by which an endpoint says that it will not answer this question, with status 400."""
KINDS = {
    Shown.FRAMES: "In place of each tactile video you see some of its frames, in their order in time: a camera behind "
    "a soft gel films how an object presses into the gel.",
    Shown.PHOTOS: "In place of each tactile video you see photos of the object that was touched in it.",
}
PUBLISHED = {
    "hardness": ("hard, soft or medium", {"soft": 0, "medium": 1, "hard": 2}),
    "roughness": ("rough, smooth or medium", {"smooth": 0, "medium": 1, "rough": 2}),
    "bumpiness": ("having big bumps, small bumps or no bumps", {"no bumps": 0, "small bumps": 1, "big bumps": 2}),
}
"""How the paper asks PG-InstructBLIP, which never said "moderately hard" or "slightly rough": what it chooses from, and
the class of each (its appendix on PG-InstructBLIP's property prediction)."""


@dataclass(frozen=True)
class Endpoint:
    """Where a model answers, and how it is asked."""

    url: str
    """Up to and with the `/v1` that most have."""
    model: str
    temperature: float = 0.0
    max_tokens: int = 1024
    """Of a reply."""
    timeout: float = 120.0
    """Seconds that a reply may take; the client then asks again, as after a status that may pass."""


class Reply(Record):
    """What came back for one request: a line of the cache."""

    request: str
    """SHA-256 of what was sent and where."""
    ended: str
    """As in `VisionModel.ended`."""
    text: str = ""
    """Empty where nothing was said."""
    tokens: int = 0
    model: str = ""
    """As the endpoint calls it."""
    day: str = Field(default_factory=lambda: datetime.now(UTC).date().isoformat())


def ask_all(
    params: Params,
    endpoint: Endpoint,
    shown: Shown,
    folder: Path,
    limit: int | None = None,
    *,
    published: bool = False,
) -> str:
    """Ask what is not in the cache yet, and write what is answered by now to `external/<report>/<model>-<shown>/`.

    Each reply is in the cache before the next request leaves, so a killed run goes on where it was. The chain must
    have run up to its questions (and frames, where they are shown). Returns a line that says what was done.

    Args:
        params: Whose questions, seeds and frames.
        folder: Folder of the kept frames, or of the photos: for each object `<object>.jpg` or a folder `<object>/`.
        limit: Most requests of this call, not counting what the client sends again; None: no limit.
        published: Only describe, by the paper's three prompts, from one photo a video where photos are shown; the
            folder's name then ends with -published.

    Raises:
        UserError: where the catalogue has other properties than the published prompts, an input is missing, or the
            endpoint fails (what it said before is kept and written).
    """
    _check(endpoint)
    name = re.sub(r"[^\w.-]+", "-", f"{endpoint.model}-{shown}{'-published' if published else ''}")
    place = EXTERNAL / params.report_name / name
    try:
        with alone(f"answer-with@{name}"):
            files = {seed: DATA / "questions" / str(seed) / "evaluation.jsonl" for seed in params.ablation.seeds}
            asked = {seed: read_jsonl(file, Question) for seed, file in files.items()}
            if published:
                asked = {seed: [q for q in questions if q.task == "OPD"] for seed, questions in asked.items()}
            every = chain.from_iterable(asked.values())
            touched = {v: o for q in every for v, o in zip(q.videos, q.objects, strict=True)}
            most = 1 if published and shown is Shown.PHOTOS else params.frames.per_video
            show = _frames(folder, most) if shown is Shown.FRAMES else _photos(folder, touched, most)
            catalogue = load_catalogue(Path(params.data.catalogue)).called(params.questions.names)
            if published and [(p.name, len(p.levels)) for p in catalogue.properties] != [(n, 3) for n in PUBLISHED]:
                raise UserError(
                    f"--prompt published: is about {', '.join(PUBLISHED)} alone, of three classes; leave it out"
                )
            asker, answered = _Asker(endpoint, place / CACHE_FILE, limit), {}
            for seed, questions in asked.items():
                training = read_jsonl(files[seed].with_name("train.jsonl"), Question)
                tasks = {q.task for q in questions}
                told = {t: instruction(catalogue, shown, choose_examples(training, t)) for t in tasks}
                said = (
                    _classify(q, catalogue, asker, show) if published else _answer(q, told[q.task], asker, show)
                    for q in track(questions, name, "question")
                )
                answered[seed] = [prediction for prediction in said if prediction]
            done, total = (sum(map(len, each.values())) for each in (answered, asked))
            if done:
                for seed, predictions in answered.items():
                    write_jsonl(place / f"{seed}.jsonl", predictions)
                # Written last, since this file vouches that the answers beside it belong to these questions.
                days = sorted(reply.day for reply in asker.used.values())
                source = VisionModel(
                    model=f"{endpoint.model}, published prompts" if published else endpoint.model,
                    served_as=tuple(sorted({reply.model for reply in asker.used.values()})),
                    endpoint=endpoint.url,
                    temperature=endpoint.temperature,
                    max_tokens=endpoint.max_tokens,
                    first=days[0],
                    last=days[-1],
                    ended=asker.ended(),
                    shown=shown,
                    per_video=most,
                    questions={str(seed): fingerprint(file) for seed, file in files.items()},
                    published=published,
                    folder=str(folder),
                    frames=frames_key(folder) if shown is Shown.FRAMES else "",
                )
                write_json(place / SOURCE_FILE, source.model_dump(mode="json"))
            state = f"{done} of {total} questions are answered"
            if asker.failure:
                raise UserError(f"{asker.failure}; {state}, run it again to go on")
    except UserError as error:
        raise UserError(f"answer-with@{name}: {error}") from None
    unusual = [f"{count} ended with {how}" for how, count in asker.ended().items() if how != "stop"]
    then = "`dvc repro` grades them" if done == total else "run it again for the others"
    return f"{place}: {'; '.join([f'{asker.sent} requests', *unusual, state, then])}"


def choose_examples(training: Sequence[Question], task: str) -> list[Question]:
    """The first `EXAMPLES` training questions of a task whose right choices differ, so that they show each kind."""
    first: dict[str, Question] = {}
    for question in training:
        if question.task == task:
            first.setdefault(question.gold.choice, question)
    return list(first.values())[:EXAMPLES]


def instruction(catalogue: Catalogue, shown: Shown, examples: Sequence[Question]) -> str:
    """What stands before a question: what is seen, the properties with their classes, and how an answer is worded.

    Examples are training questions of the task, told in words; there are none where it is never trained.
    """
    classes = "; ".join(f"{p.spoken} ({', '.join(p.levels)})" for p in catalogue.properties)
    form = catalogue.language.structured.format(**{p.name: f"<{p.spoken}>" for p in catalogue.properties})
    turns = [turn for q in examples for d in q.dialogues if d.opd is Opd.ALL for turn in d.turns]
    lines = [
        KINDS[shown],
        f"Objects have these properties, each in one of the classes in brackets: {classes}.",
        f'A description of an object ends with a sentence of exactly this form: "{form}"',
    ]
    if turns:
        lines.append("Answer in the form of these examples, whose pictures are left out.")
        lines += [f"Question: {turn.user}\nAnswer: {turn.assistant}" for turn in turns]
        lines.append("Now the question:")
    return "\n".join(lines).replace("{tactile}", "[pictures]") + "\n\n"


def _answer(question: Question, told: str, asker: _Asker, show: Show) -> Prediction | None:
    """Ask all turns of a question, as the full system is asked; None where a reply is not to be had."""
    dialogue = question.dialogue(Opd.ALL)
    assert dialogue is not None, "every task has this mode"
    messages: list[dict[str, Any]] = []
    replies: list[Reply] = []
    touched = iter(question.videos)
    for turn in dialogue.turns:
        first, *others = (turn.user if messages else told + turn.user).split("{tactile}")
        content: list[dict[str, Any]] = [{"type": "text", "text": first}]
        for text in others:
            content += map(_picture, show(next(touched)))
            content += [{"type": "text", "text": text}] if text else []
        messages.append({"role": "user", "content": content})
        reply = asker.ask(messages)
        if reply is None:
            return None
        replies.append(reply)
        if not reply.text:
            # Endpoints take no empty turn, and nothing can follow from one.
            break
        messages.append({"role": "assistant", "content": reply.text})
    unsaid = len(dialogue.turns) - len(replies)
    return _predicted(question, (*(r.text for r in replies), *[""] * unsaid), replies)


def _classify(question: Question, catalogue: Catalogue, asker: _Asker, show: Show) -> Prediction | None:
    """Ask the published prompts about one object, and word the replies as a description; other replies stay unknown."""
    pictures = [*map(_picture, show(*question.videos))]
    told, replies = {}, []
    for prop in catalogue.properties:
        choices, classes = PUBLISHED[prop.name]
        prompt = f"Classify the object as {choices}? Respond unknown if you are not sure. Short answer:"
        reply = asker.ask([{"role": "user", "content": [*pictures, {"type": "text", "text": prompt}]}])
        if reply is None:
            return None
        replies.append(reply)
        # One that names two classes has chosen none.
        named = [level for words, level in classes.items() if re.search(rf"\b{words}\b", reply.text.lower())]
        told[prop.name] = prop.levels[named[0]] if len(named) == 1 else "unknown"
    return _predicted(question, (catalogue.language.structured.format(**told),), replies)


def _predicted(question: Question, outputs: tuple[str, ...], replies: Sequence[Reply]) -> Prediction:
    cut, tokens = any(r.ended == "length" for r in replies), sum(r.tokens for r in replies)
    whose = {"question_id": question.question_id, "task": question.task}
    return Prediction(**whose, outputs=outputs, truncated=cut, tokens=tokens)


def _picture(url: str) -> dict[str, Any]:
    return {"type": "image_url", "image_url": {"url": url}}


class _Asker:
    """Replies to requests: from the cache, else from the endpoint until it fails or `limit` requests are sent."""

    def __init__(self, endpoint: Endpoint, cache: Path, limit: int | None) -> None:
        import openai

        self._key = os.environ.get("OPENAI_API_KEY", "").strip()
        if not (self._key.isascii() and self._key.isprintable()):
            raise UserError("OPENAI_API_KEY: has characters that no key has; set it again")
        self.endpoint, self._cache, self._limit = endpoint, cache, limit
        # A server of one's own wants no key, but the client does.
        self._client = openai.OpenAI(base_url=endpoint.url, api_key=self._key or "none", timeout=endpoint.timeout)
        self._known = _read_cache(cache)
        self.used: dict[str, Reply] = {}
        self.sent = 0
        self.failure = ""
        """Why the endpoint is asked no more."""

    def ended(self) -> dict[str, int]:
        """How many of the replies that were used ended in each way."""
        return dict(sorted(Counter(reply.ended for reply in self.used.values()).items()))

    def ask(self, messages: Sequence[dict[str, Any]]) -> Reply | None:
        """The reply to a conversation; None where it is not known and may not be asked for."""
        body = {
            "model": self.endpoint.model,
            "messages": list(messages),
            "temperature": self.endpoint.temperature,
            "max_completion_tokens": self.endpoint.max_tokens,
        }
        request = hashlib.sha256(json.dumps([self.endpoint.url, body], sort_keys=True).encode()).hexdigest()
        if request not in self._known:
            if self.failure or self.sent == self._limit:
                return None
            self.sent += 1
            try:
                reply = self._send(request, body)
            except UserError as error:
                # In one short line; an endpoint may quote the key.
                why = " ".join(str(error).split())
                if self._key:
                    why = why.replace(self._key, "[key]")
                self.failure = f"{self.endpoint.url}: {why}"[:400]
                return None
            self._cache.parent.mkdir(parents=True, exist_ok=True)
            with self._cache.open("a", encoding="utf-8") as stream:
                stream.write(reply.model_dump_json() + "\n")
            self._known[request] = reply
        self.used[request] = self._known[request]
        return self.used[request]

    def _send(self, request: str, body: dict[str, Any]) -> Reply:
        """What the endpoint says; a refusal to answer this question is a reply, too."""
        import openai

        try:
            completion = self._client.chat.completions.create(**body)
        except openai.APIStatusError as error:
            if error.status_code == 400 and error.code in FILTERS:
                return Reply(request=request, ended=FILTERS[0])
            keyless = error.status_code in (401, 403) and not self._key
            raise UserError(f"{'OPENAI_API_KEY is not set: ' if keyless else ''}{error.message}") from None
        except openai.APITimeoutError:
            raise UserError(f"no answer within {self.endpoint.timeout:g} s") from None
        except openai.APIConnectionError as error:
            raise UserError(f"cannot be reached ({error.__cause__ or error})") from None
        except (openai.OpenAIError, ValueError) as error:
            raise UserError(f"its answer is no JSON ({error}); is the URL right?") from None
        # The client checks no types: any part may be missing or be something else.
        choices = getattr(completion, "choices", None)
        if not isinstance(choices, list):
            raise UserError(
                f"its answer has no choices ({getattr(completion, 'error', None) or completion}); is the URL right?"
            )
        choice = next(iter(choices), None)
        message, ended = getattr(choice, "message", None), getattr(choice, "finish_reason", None)
        content, tokens = getattr(message, "content", None), getattr(completion.usage, "completion_tokens", None)
        # Half a character, which JSON can hold, cannot be written to a file.
        text = content.encode(errors="replace").decode().strip() if isinstance(content, str) else ""
        if getattr(message, "refusal", None):
            text, ended = "", "refusal"
        elif not text and ended in (None, "stop"):
            ended = "nothing"
        return Reply(
            request=request,
            text=text,
            ended=str(ended or "unsaid"),
            tokens=tokens if isinstance(tokens, int) else 0,
            model=str(getattr(completion, "model", None) or ""),
        )


def _read_cache(file: Path) -> dict[str, Reply]:
    """Replies by request; half a line at the end is cut off."""
    if not file.is_file():
        return {}
    content = file.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        # A run that was killed while it wrote: that reply is asked for again.
        with file.open("rb+") as stream:
            stream.truncate(whole)
    try:
        return {reply.request: reply for reply in read_jsonl(file, Reply)}
    except UserError as error:  # Its advice, to delete the file, would throw away what was paid for.
        where = str(error).rpartition("; ")[0]
        raise UserError(f"{where}; remove that line: its question alone is asked again") from None


def _check(endpoint: Endpoint) -> None:
    """Refuse what is no URL, or holds a secret."""
    try:
        url = TypeAdapter(HttpUrl).validate_python(endpoint.url)
    except ValidationError:
        raise UserError(f"--endpoint: {endpoint.url} is no URL such as https://api.openai.com/v1") from None
    if url.username or url.password or url.query or url.fragment:
        raise UserError("--endpoint: the URL is written beside the answers; put a key into OPENAI_API_KEY instead")
    if not endpoint.model.strip():
        raise UserError("--model: is empty; name one that the endpoint has")


def _frames(folder: Path, most: int) -> Show:
    """Those frames of a video that every variant is given, as PNG: what was kept, bit by bit."""
    store = FrameStore(folder)

    @lru_cache(maxsize=64)
    def show(video_id: str) -> list[str]:
        count = len(store.rows(video_id))
        if not count:
            raise UserError(f"{folder}: no frame of {video_id}; run `dvc repro extract_frames`")
        frames = store.pictures(video_id, sorted(set(sample_evaluation(count, most))))
        return [_url(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), "png") for frame in frames]

    return show


def _photos(folder: Path, touched: Mapping[str, str], most: int) -> Show:
    """Photos of the object that was touched in a video, upright; with `most` 1, each of its videos gets the next one.

    They are encoded anew, so that no EXIF data (such as the place) leaves.
    """
    found: dict[str, list[Path]] = {}
    for name in sorted({*touched.values()}):
        # Those named after it, and those in the folder of its name.
        files = chain(folder.glob(f"{name}.*"), (folder / name).glob("[!.]*"))
        found[name] = sorted(f for f in files if f.suffix.lower() in PHOTO_SUFFIXES)
    if missing := [o for o, files in found.items() if not files]:
        name, kinds = missing[0], ", ".join(PHOTO_SUFFIXES)
        others = f" (nor of {len(missing) - 1} others)" if missing[1:] else ""
        raise UserError(f"{folder}: no photo of {name}{others}; put {name}.jpg or a folder {name}/ there ({kinds})")

    @lru_cache(maxsize=64)
    def read(file: Path) -> str:
        data = np.fromfile(file, np.uint8)
        # OpenCV turns it as its camera noted that it was held.
        photo = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        if photo is None:
            raise UserError(f"{file}: not a picture that can be read; replace it")
        scale = min(1.0, LONGEST / max(photo.shape[:2]))
        return _url(cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), "jpeg")

    def show(video_id: str) -> list[str]:
        files, own = found[touched[video_id]], sorted(v for v, o in touched.items() if o == touched[video_id])
        places = sorted({*sample_evaluation(len(files), most)}) if most > 1 else [own.index(video_id) % len(files)]
        return [read(files[i]) for i in places]

    return show


def _url(picture: cv2.typing.MatLike, kind: str) -> str:
    """A picture of rows x columns x BGR as a data URL."""
    _, data = cv2.imencode(f".{kind}", picture)
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"
