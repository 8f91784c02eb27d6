"""Ask a vision-language model behind an OpenAI-compatible endpoint the evaluation questions.

In place of tactile videos it gets pictures. The paper compares with such a model, PG-InstructBLIP (Gao et al. 2024,
arXiv:2309.02561), which it asks for classes alone. Answers are written to `external/`, which the stages `grade` and
`report` read: no stage asks a network.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import Field

from pipeline.config import Params
from pipeline.core.io import read_jsonl
from pipeline.core.layout import EXTERNAL, questions_file
from pipeline.core.records import Opd, Prediction, Question, Record
from pipeline.evaluation.outside import asked, record, turns_of
from pipeline.evaluation.pictures import Show, frames, photos
from pipeline.evaluation.records import Shown, VisionModel
from pipeline.running.errors import UserError
from pipeline.running.progress import track
from pipeline.running.stage import alone
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.frames.store import frames_key

EXAMPLES = 3
"""Most training questions that stand before a question as examples (few-shot)."""
FILTERS = ("content_filter", "content_policy_violation")
"""Codes by which an endpoint says that it will not answer this question, with status 400."""
KINDS = {
    Shown.FRAMES: "In place of each tactile video you see some of its frames, in their order in time: a camera behind "
    "a soft gel films how an object presses into the gel.",
    Shown.PHOTOS: "In place of each tactile video you see photos of the object that was touched in it.",
}


class EndpointReply(Record):
    """What came back for one request: a line of cache.jsonl."""

    request: str
    """SHA-256 of what was sent and where."""
    ended: str
    """As in `VisionModel.ended`."""
    text: str = ""
    tokens: int = 0
    model: str = ""
    """As the endpoint calls it."""
    day: str = Field(default_factory=lambda: datetime.now(UTC).date().isoformat())


def ask_all(params: Params, url: str, settings: Mapping[str, Any], shown: Shown, folder: Path) -> str:
    """Ask what is not in the cache yet, and write the answers to `external/<report>/<model>-<shown>/`.

    Each reply is in the cache before the next request leaves, so a run that ended goes on where it was. The chain must
    have run up to its questions (and frames, where they are shown). Returns a line that says what was done.

    Args:
        url: Of the endpoint, up to and with the `/v1` that most have.
        settings: What a request has beside its messages: `model`, `temperature` and `max_completion_tokens`.
        folder: Of the kept frames, or of the photos: for each object `<object>.jpg` or a folder `<object>/`.

    Raises:
        UserError: where an input is missing, or the endpoint fails.
    """
    if re.search("[@?]", url):
        raise UserError("--endpoint: the URL is written beside the answers; put a key into OPENAI_API_KEY instead")
    name = re.sub(r"[^\w.-]+", "-", f"{settings['model']}-{shown}")
    place, most = EXTERNAL / params.report_name / name, params.frames.per_video
    catalogue = load_catalogue(Path(params.data.catalogue)).called(params.questions.names)
    with alone(f"answer-with@{name}"):
        every = [(seed, question) for seed, own in asked(params).items() for question in own]
        training = {seed: read_jsonl(questions_file(seed, "train"), Question) for seed in params.ablation.seeds}
        show = (frames if shown is Shown.FRAMES else photos)(folder, [question for _, question in every], most)
        endpoint, used = _Endpoint(url, settings, place / "cache.jsonl"), dict[str, EndpointReply]()
        answers: dict[int, list[Prediction]] = {seed: [] for seed in training}
        for seed, question in track(every, name, "question"):
            turns = turns_of(question)
            turns[0] = instruction(catalogue, shown, training[seed], question.task) + turns[0]
            replies = endpoint.converse(turns, question.videos, show)
            used |= {reply.request: reply for reply in replies}
            said = [*(reply.text for reply in replies), *[""] * (len(turns) - len(replies))]
            cut, tokens = any(r.ended == "length" for r in replies), sum(r.tokens for r in replies)
            whose = {"question_id": question.question_id, "task": question.task}
            answers[seed].append(Prediction(**whose, outputs=tuple(said), truncated=cut, tokens=tokens))
        ended = Counter(sorted(reply.ended for reply in used.values()))
        source = VisionModel(
            model=settings["model"],
            served_as=tuple(sorted({reply.model for reply in used.values()})),
            endpoint=url,
            temperature=settings["temperature"],
            max_tokens=settings["max_completion_tokens"],
            first=min((reply.day for reply in used.values()), default=""),
            last=max((reply.day for reply in used.values()), default=""),
            ended=ended,
            shown=shown,
            per_video=most,
            folder=str(folder),
            frames=frames_key(folder) if shown is Shown.FRAMES else "",
        )
        record(params, name, source, answers)
    how = ", ".join(f"{count} {kind}" for kind, count in ended.items())
    return f"{place}: {len(every)} questions answered by {endpoint.sent} requests ({how}); `dvc repro` grades them"


def instruction(catalogue: Catalogue, shown: Shown, training: Sequence[Question], task: str) -> str:
    """What stands before a question: what is seen, the properties with their classes, and how an answer is worded.

    Examples are the first training questions of the task whose right choices differ, told in words; there are none
    where it is never trained. Long dialogues come last, as evaluation has none of them (`questions.two_turns`).
    """
    first: dict[str, Question] = {}
    for q in sorted((q for q in training if q.task == task), key=lambda q: max(len(d.turns) for d in q.dialogues)):
        first.setdefault(q.gold.choice, q)
    turns = [turn for q in [*first.values()][:EXAMPLES] for d in q.dialogues if d.opd is Opd.ALL for turn in d.turns]
    classes = "; ".join(f"{p.spoken} ({', '.join(p.levels)})" for p in catalogue.properties)
    form = catalogue.language.structured.format(**{p.name: f"<{p.spoken}>" for p in catalogue.properties})
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


class _Endpoint:
    """Replies to conversations: from the cache, else from the endpoint."""

    def __init__(self, url: str, settings: Mapping[str, Any], cache: Path) -> None:
        import openai

        self.url, self.settings, self.cache, self.sent = url, settings, cache, 0
        # A server of one's own wants no key, but the client does.
        self.client = openai.OpenAI(base_url=url, api_key=os.environ.get("OPENAI_API_KEY", "").strip() or "none")
        cache.parent.mkdir(parents=True, exist_ok=True)
        content = cache.read_bytes() if cache.is_file() else b""
        if not content.endswith(b"\n"):
            # Half a line, of a run that was killed while it wrote, is asked for again.
            cache.write_bytes(content[: content.rfind(b"\n") + 1])
        self.known = {reply.request: reply for reply in read_jsonl(cache, EndpointReply)}

    def converse(self, turns: Sequence[str], videos: Sequence[str], show: Show) -> list[EndpointReply]:
        """Ask turn after turn, with pictures where a text has `{tactile}`; nothing follows a reply without text."""
        messages, replies, touched = list[dict[str, Any]](), list[EndpointReply](), iter(videos)
        for turn in turns:
            content: list[dict[str, Any]] = []
            for place, text in enumerate(turn.split("{tactile}")):
                urls = show(next(touched)) if place else []
                content += [{"type": "image_url", "image_url": {"url": url}} for url in urls]
                content += [{"type": "text", "text": text}] if text else []
            messages.append({"role": "user", "content": content})
            sent = json.dumps([self.url, {**self.settings, "messages": messages}], sort_keys=True)
            request = hashlib.sha256(sent.encode()).hexdigest()
            if request not in self.known:
                self.known[request] = self._ask(request, messages)
                self.sent += 1
                with self.cache.open("a", encoding="utf-8") as stream:
                    stream.write(self.known[request].model_dump_json() + "\n")
            replies.append(self.known[request])
            if not replies[-1].text:
                break
            messages.append({"role": "assistant", "content": replies[-1].text})
        return replies

    def _ask(self, request: str, messages: Any) -> EndpointReply:
        """What the endpoint says; a refusal to answer this question is a reply, too."""
        import openai

        try:
            completion = self.client.chat.completions.create(**self.settings, messages=messages)
            choice = completion.choices[0]
            # Half a character, which JSON can hold, cannot be written to a file.
            text = (choice.message.content or "").encode(errors="replace").decode().strip()
            ended = "refusal" if choice.message.refusal else choice.finish_reason or "unsaid"
            tokens = completion.usage.completion_tokens if completion.usage else 0
        except (openai.OpenAIError, ValueError, TypeError, AttributeError, IndexError) as error:
            if getattr(error, "status_code", 0) == 400 and getattr(error, "code", "") in FILTERS:
                return EndpointReply(request=request, ended=FILTERS[0])
            failed = isinstance(error, openai.OpenAIError | ValueError)
            why = str(error.__cause__ or error) if failed else f"no chat completion ({completion}); is the URL right?"
            why = " ".join(why.split()).replace(self.client.api_key, "[key]")[:300]
            raise UserError(f"{self.url}: {why}; what it said before is kept, run it again to go on") from None
        ended = "nothing" if ended == "stop" and not text else ended
        return EndpointReply(request=request, ended=ended, text=text, tokens=tokens, model=completion.model or "")
