"""A trained model, ready to be asked: the same code that the evaluation runs, from a video's file to the answer."""

from __future__ import annotations

import importlib
import logging
import os
import random
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from huggingface_hub import ModelCardData

from pipeline.config import LANGUAGE_DIR, LanguageConfig
from pipeline.core.io import fingerprint
from pipeline.core.layout import SHIPPED
from pipeline.core.records import Opd, Turn
from pipeline.core.runtime import DeviceName, DtypeName, Quantization, derive_seed, name_dtype, resolve_device
from pipeline.language.chat import TACTILE, TACTILE_TOKENS
from pipeline.language.generate import Stream, reply, write_prompt
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.running.errors import UserError, counted, did_you_mean, readable
from pipeline.running.progress import quiet_libraries
from pipeline.tasks import opd, pc, pom, psr, pss
from pipeline.tasks.base import LETTERS, conclusion
from pipeline.training.card import front_matter
from pipeline.use.encoding import Classified, EncodedVideo, Verdict, VideoEncoder
from pipeline.use.folder import ENCODER_DIR, FITTED, ModelConfig, chat_sample, find_base, find_property, read_folder
from pipeline.use.hub import HUB, download
from pipeline.use.memory import Remembered, most_similar, recall, remember
from pipeline.use.results import Choice, Comparison, Description, Exchange, Matching, Ranking, Recognition, Touch, Video
from pipeline.videos.catalogue import Catalogue, Object
from pipeline.videos.catalogue.wording import mentioned
from pipeline.videos.files import video_files
from pipeline.weights import is_random
from pipeline.weights.backbones import reads_weights

if TYPE_CHECKING:
    import pandas as pd

NUMBERED = re.compile(r"object \d+")
ALONE = "the question compares, but there is one video: what it says of another is made up"
APART = "the sentence and the property heads disagree; heads alone are right more often (the card has both)"
DIVIDED = "the answer and the classes that the model's sentences name disagree"
UNTOLD = "this variant was not trained to describe, so there is no sentence"
MUTE = "its language model knows other properties and is not asked; property heads alone answer"
RANDOM = "its base models are tiny and random, made to test the chain: no answer of it means anything"

SYNTHETIC = "it was trained on synthetic touches alone; adapt it to your sensor with ratings (docs/use.md); "
UNRATED = "it was trained on synthetic touches, and fitted to a sensor without ratings: nobody measured what it reaches"
REAL = "real-tactile-videos"
"""Type of the data that a card's results on real videos, none of which was trained on, are listed under."""

logger = logging.getLogger(__name__)


class Octopi:
    """A trained model: `Octopi.from_pretrained("models/finetuned-with-all-0").ask("...{tactile}...", ["a.mov"])`.

    It remembers no conversation: the caller hands the earlier exchanges in. One call at a time.

    Attributes:
        folder: The folder that it was loaded from.
        name: The folder's name for the shipped model, else the variant's.
        config: What the folder's config.json says.
        properties: The catalogue's properties.
        numbered: Whether training named objects only "object 1" and so on; such a model cannot repeat other names.
        doubts: What should make one doubt every answer: random weights, or another language model than in training.
    """

    def __init__(
        self, folder: Path, config: ModelConfig, catalogue: Catalogue, llm: OctopiForCausalLM, device: torch.device
    ) -> None:
        self.folder, self.config, self.catalogue = folder, config, catalogue
        self.name = SHIPPED.name if folder == SHIPPED else config.variant
        self.llm = llm.to(device)
        self.properties: tuple[str, ...] = catalogue.property_names
        names = [o.name for o in catalogue.objects.values()]
        self.numbered = config.names == "number" or all(map(NUMBERED.fullmatch, names))
        self.encoder = VideoEncoder(folder, config, catalogue, device)
        files = sorted((name, known) for name, known in config.files.items() if name.startswith(ENCODER_DIR))
        self._encoder_name = fingerprint(config.frames, *(part for file in files for part in file))
        bases = (config.base.folder, *([config.encoder.weights] if reads_weights(config.encoder) else []))
        self.doubts: tuple[str, ...] = (RANDOM,) if any(map(is_random, bases)) else ()
        if not config.rated:
            self.doubts += (UNRATED if config.trained_on == FITTED else SYNTHETIC + on_real_videos(folder),)

    def __repr__(self) -> str:
        scores = ", ".join(f"{task} {100 * accuracy:.0f} %" for task, (accuracy, *_) in self.config.scores.items())
        base, source = self.config.base.folder, self.config.trained_on
        return f"Octopi({self.name}, base {base}, trained on {source}; {scores or 'no scores'})"

    @classmethod
    def from_pretrained(
        cls,
        folder: Path | str | None = None,
        *,
        revision: str | None = None,
        base: Path | str | None = None,
        device: DeviceName = "auto",
        dtype: DtypeName = "auto",
    ) -> Self:
        """Load a folder that `dvc repro package` wrote.

        Args:
            folder: `models/<variant>`, or a copy of it; by default the model that is shipped, and a line says so.
                "hf://USER/NAME", and this form alone, is downloaded from the Hugging Face Hub, and kept in its cache.
            revision: Of a model on the Hub: branch, tag or commit.
            base: Folder of the language model; by default the first known place that has it. Another of the same
                shapes and vocabulary is taken, and doubted.
            device: What to compute on; `auto` takes CUDA, then MPS, then the CPU.
            dtype: Number format of the language model; `auto` is that of the evaluation, where the device computes it.

        Raises:
            UserError: naming what is missing, changed, of another version, or another language model.
        """
        quiet_libraries()
        if folder is None:
            logger.warning(
                "no model is named, so %s answers, which is shipped (its README.md has its figures)", SHIPPED
            )
        if isinstance(folder, str) and folder.startswith(HUB):
            folder = download(folder, revision)
        elif revision is not None:
            raise UserError(f"{folder}: a folder has no revision {revision}; name a model on the Hub, {HUB}USER/NAME")
        folder = SHIPPED if folder is None else Path(folder)
        config, catalogue = read_folder(folder)
        found, doubts = find_base(folder, config.base, None if base is None else Path(base))
        place = resolve_device(device)
        if dtype == "auto":
            dtype = "float32" if config.language.dtype == "float32" else name_dtype("auto", device)
        quantization: Quantization = config.language.quantization if place.type == "cuda" else "none"
        llm = OctopiForCausalLM.from_pretrained(
            folder / LANGUAGE_DIR, base=found, dtype=dtype, quantization=quantization
        )
        if chat_sample(llm.tokenizer, config.language) != config.chat:
            raise UserError(
                f"{found}: its chat format is another than in training; name the folder of {config.base.folder}"
            )
        model = cls(folder, config, catalogue, llm, place)
        model.doubts += doubts
        return model

    # ---- asking ----

    def ask(
        self,
        question: str,
        videos: Video | Sequence[Video] = (),
        *,
        history: Sequence[Exchange] = (),
        max_new_tokens: int | None = None,
        memory: Path | str | None = None,
        more: bool = False,
    ) -> str:
        """Answer a question.

        Args:
            question: With "{tactile}" once for each video, in their order; without any, the videos stand in front.
            videos: Files, or arrays of uint8, frames x height x width x RGB; one, or several in a list.
            history: Earlier exchanges of the conversation.
            max_new_tokens: Of the answer; by default those of the evaluation.
            memory: A folder of remembered touches: the question begins with name and classes of the object that each
                video is most similar to.
            more: Whether another question follows, which the published chat format writes otherwise from the first on.

        Raises:
            UserError: for a question that does not fit its videos or is too long, or a video that cannot be used.
        """
        if memory is not None:
            question = self.reminded(question, _listed(videos), memory)
        return self._reply([self._prompt(question, videos, history, more=more)], max_new_tokens)[0]

    def stream(
        self,
        question: str,
        videos: Video | Sequence[Video] = (),
        *,
        history: Sequence[Exchange] = (),
        max_new_tokens: int | None = None,
        more: bool = False,
    ) -> Stream:
        """As `ask`, in pieces of text as they come. Bad input is refused here, before the first piece is asked for."""
        return Stream(self.llm, *self._prompt(question, videos, history, more=more), self._language(max_new_tokens))

    def ask_all(
        self, asked: Sequence[tuple[str, Video | Sequence[Video]]], *, max_new_tokens: int | None = None
    ) -> list[str]:
        """As `ask`, of many questions in one batch."""
        return self._reply([self._prompt(question, videos) for question, videos in asked], max_new_tokens)

    def look(self, video: Video) -> Touch:
        """The frames of a video that the model is given, and what they show.

        Raises:
            UserError: for what is no video, or is too short.
        """
        return self.encoder.encode(video).touch

    def notes(self, videos: Video | Sequence[Video] = (), question: str = "") -> tuple[str, ...]:
        """What should make one doubt an answer: of the model itself, of the question, then of each named video."""
        found = [self.encoder.encode(video) for video in _listed(videos)]
        of_videos = (f"{encoded.name}: {note}" for encoded in found for note in encoded.touch.notes)
        return (*self.doubts_about(question, len(found)), *of_videos)

    def doubts_about(self, question: str, videos: int) -> tuple[str, ...]:
        """`doubts`, and that a question compares where there is only one video."""
        words = {word for p in self.catalogue.properties for word in (p.more, p.less, p.most, p.least)}
        compares = any(word in question.lower() for word in ("which", *words))
        return (*self.doubts, *((ALONE,) if compares and videos == 1 else ()))

    def verdict(self, question: str, videos: Video | Sequence[Video] = ()) -> Verdict | None:
        """What the heads say to a question; None where there are none, or no rule leads from them to an answer.

        One video is described; two or three are compared where the question names one property, as "softer" does.
        """
        files, properties = _listed(videos), self.catalogue.properties
        asked = mentioned(question, (word for p in properties for word in (p.more, p.less, p.most, p.least)))
        if not self.config.heads or (len(files), len(asked)) not in ((1, 0), (2, 1), (3, 1)):
            return None
        if not asked:
            found = self.encoder.classify(files[0])
            each = zip(properties, found.levels, found.probabilities, strict=True)
            told = (f"{p.levels[level]} ({self.config.share(known[level])})" for p, level, known in each)
            return Verdict(self.catalogue.structured(found.levels), ", ".join(told))
        known, rising = find_property(self.catalogue, asked[0])
        classes = [self._classes(video)[self.properties.index(known.name)] for video in files]
        if len(files) == 2:
            choice = pc.compare(classes[0][0], classes[1][0], rising)
            # As "Which is softer?" is answered: without a Yes or No.
            said = re.sub("^(Yes|No), the", "The", pc.in_words(choice, known.more if rising else known.less, known))
        else:
            place = (max if rising else min)(range(3), key=classes.__getitem__)
            said = f"{LETTERS[place]}) is the {known.most if rising else known.least}."
        told = (f"{known.levels[level]} ({value:.2f})" for level, value in classes)
        return Verdict(said, f"{known.spoken} {', '.join(told)}, from 0 to {len(known.levels) - 1}: {said}")

    def apart(self, answer: str, heads: Verdict | None) -> tuple[str, ...]:
        """A note where an answer, as far as it can be read, says something else than the heads."""
        if heads is None:
            return ()
        said, ruled = self._read(answer), self._read(heads.said)
        return (APART,) if any(ruled.get(key, value) != value for key, value in said.items()) else ()

    def _read(self, answer: str) -> dict[str, str]:
        """The classes that an answer closes with, and the video that it chooses."""
        named = mentioned(" ".join(conclusion(answer)), ("first", "second", "both"))
        choice = named[0] if len(named) == 1 else pss.read(answer)
        return opd.named(answer, self.catalogue) | ({"choice": choice} if choice else {})

    # ---- the tasks ----

    def describe(self, video: Video, *, sentence: bool = True) -> Description:
        """The classes of a video's properties, with their probabilities, and the model's own sentence.

        Args:
            sentence: False leaves it empty, which takes a fraction of the time.
        """
        return self.describe_all([video], sentence=sentence)[0]

    def describe_all(self, videos: Video | Sequence[Video], *, sentence: bool = True) -> list[Description]:
        """As `describe`, of many videos, or those of a folder, in one batch; one without contact has a note."""
        videos = _listed(videos)
        described, asked = [], []
        heads, tells = self.config.heads, self.config.opd is not Opd.NONE and self.config.speaks
        doubts: tuple[str, ...] = () if tells else (UNTOLD if self.config.speaks else MUTE,)
        doubts += () if heads else ("it has no property heads; its classes are those that its sentence names",)
        for video in videos:  # All of a video at once, as not all may be remembered.
            encoded, classified = self.encoder.encode(video), self.encoder.classify(video) if heads else Classified()
            each = list(zip(self.catalogue.properties, classified.probabilities, classified.levels, strict=heads))
            description = Description(
                video=encoded.name,
                calibrated=self.config.calibrated,
                levels={p.name: p.levels[level] for p, _, level in each},
                probabilities={p.name: dict(zip(p.levels, found, strict=True)) for p, found, _ in each},
                sentence="",
                frames=encoded.touch.numbers,
                notes=(*self.doubts, *encoded.touch.notes, *doubts),
            )
            described.append(description)
            if tells and (sentence or not heads):
                asked.append(self._prompt(opd.TEMPLATES[0], video, untouched=True))
        said = self._reply(asked, None) or [""] * len(videos)
        for place, text in enumerate(said):
            named, found = opd.named(text, self.catalogue), described[place]
            update: dict[str, object] = {"sentence": text} | ({"levels": named} if named and not heads else {})
            if any(found.levels.get(name, level) != level for name, level in named.items()):
                update["notes"] = (*found.notes, APART)
            described[place] = found.model_copy(update=update)
        return described

    def table(self, videos: Path | str | Sequence[Path | str]) -> pd.DataFrame:
        """Descriptions of videos, or of those of folders: the table that `octopi describe --csv` writes."""
        # Named, not imported: the stage `evaluate` imports this file, and makes no such table.
        paths = [Path(v) for v in ([videos] if isinstance(videos, (str, Path)) else videos)]
        return importlib.import_module("pipeline.use.ask").table(self, paths)

    def compare(self, a: Video, b: Video, property: str) -> Comparison:
        """Whether the first video is more of a property ("hardness", "harder") than the second, or less ("softer")."""
        known, rising = find_property(self.catalogue, property)
        comparative, opposite = (known.more, known.less) if rising else (known.less, known.more)
        question = pc.asked(pc.TEMPLATES[0], comparative, known.spoken)[self.config.opd]
        answer = self.ask(question, [a, b])
        ruled = self.verdict(question, [a, b])
        notes, heads = (*self.apart(answer, ruled), *self.notes([a, b])), ruled.shown if ruled else ""
        choice = pc.read(answer, comparative, opposite)
        return Comparison(question=question, answer=answer, choice=choice, heads=heads, notes=notes)

    def rank(self, videos: Video | Sequence[Video], property: str) -> Ranking:
        """Videos by a property, least first: by the heads, and the model's own answer for two or three.

        By "softer" or "softest" in place of "hardness", the hardest is first.

        Raises:
            UserError: for fewer than two videos, or one in which nothing is touched.
        """
        videos = _listed(videos)
        if len(videos) < 2:
            raise UserError(f"{counted(len(videos), 'video')}: two or more can be ranked")
        known, rising = find_property(self.catalogue, property)
        place = self.properties.index(known.name)
        expected: list[float] = []
        notes: list[str] = []
        for video in videos:  # All of a video at once, as not all may be remembered.
            encoded = self.touched(video)
            notes += [f"{encoded.name}: {note}" for note in encoded.touch.notes]
            expected.append(self._classes(video)[place][1])
        answer, most = "", None
        if not self.config.speaks:
            notes.append(MUTE)
        elif len(videos) == 3:
            superlative, opposite = (known.most, known.least) if rising else (known.least, known.most)
            answer = self.ask(pss.asked(pss.TEMPLATES[0], superlative, known.spoken)[self.config.opd], videos)
            letter = pss.read(answer, opposite)
            most = None if letter is None else LETTERS.index(letter)
        elif len(videos) == 2:
            compared = self.compare(videos[0], videos[1], property)
            answer, most = compared.answer, {"yes": 0, "no": 1}.get(compared.choice or "")
            notes += compared.notes
        order = sorted(range(len(videos)), key=lambda i: expected[i] if rising else -expected[i])
        if most is not None and expected[most] != expected[order[-1]]:
            notes.append(APART if self.config.heads else DIVIDED)
        return Ranking(
            property=known.name,
            levels=known.levels,
            order=tuple(order),
            expected=tuple(expected),
            answer=answer,
            most=most,
            notes=tuple(dict.fromkeys((*self.doubts, *notes))),
        )

    def match(self, videos: Sequence[Video], names: Sequence[str] | Mapping[str, Sequence[str]]) -> Matching:
        """Which of two or three videos is of which of as many objects.

        It was trained to match three; for two a note says so.

        Args:
            names: Names or ids of objects of the catalogue; or any names, each with its class of every property. A
                model that knows numbers alone is asked about "object 1", ...; its answer has the names.
        """
        if len(videos) != len(names) or len(videos) not in (2, 3):
            given = f"{counted(len(videos), 'video')} and {counted(len(names), 'name')} ({'; '.join(names)})"
            raise UserError(f"{given}: two or three of each can be matched; write {self._example()}; ...")
        told = names if isinstance(names, Mapping) else {}
        objects = [self._object(name, told.get(name)) for name in names]
        if len({o.object_id for o in objects}) < len(names):
            raise UserError(f"{', '.join(names)}: a name is given twice; name {len(names)} objects")
        # What the question calls each object, and its own name, which the answer is given in.
        called = {f"object {n}" if self.numbered else o.name: o.name for n, o in enumerate(objects, 1)}
        objects = [o.model_copy(update={"name": name}) for o, name in zip(objects, called, strict=True)]
        found = {o.object_id: o for o in sorted(objects, key=lambda o: o.name.lower())}
        listed = [o.name for o in found.values()]
        catalogue = Catalogue(language=self.catalogue.language, objects=found)
        question = pom.asked(pom.OPENINGS[len(listed) == 2], listed)[self.config.opd]
        if self.config.facts or told:
            facts = pom.facts(catalogue, list(found), random.Random(derive_seed("facts", *listed)))
            question = f"{facts} {question}"
        answer = self.ask(question, videos) if self.config.speaks else ""
        read = pom.read(answer, listed)
        said = None if read is None else tuple(called[listed[read[letter]]] for letter in LETTERS[: len(listed)])
        nearest = pom.nearest([self._classes(video) for video in videos], catalogue)
        heads = tuple(called[found[i].name] for i in nearest)
        answer = NUMBERED.sub(lambda name: called.get(name[0], name[0]), answer)
        untrained = () if len(listed) == 3 else ("it was trained to match three videos, not two",)
        untrained = untrained if self.config.speaks else (MUTE,)
        apart = (APART if self.config.heads else DIVIDED,) if said not in (None, heads) else ()
        notes = (*untrained, *apart, *self.notes(videos))
        return Matching(question=question, answer=answer, names=said, heads=heads, notes=notes)

    def remember(self, name: str, video: Video, memory: Path | str) -> int:
        """Keep a touch of a named object in a folder, which is made where there is none; how many it has now.

        Raises:
            UserError: for a video in which nothing is touched, or a memory that is broken or another encoder's.
        """
        encoded = self.touched(video)
        levels = [level for level, _ in self._classes(video)]
        classes = tuple(p.levels[level] for p, level in zip(self.catalogue.properties, levels, strict=True))
        embedding = tuple(encoded.raw.mean(0).tolist())
        touch = Remembered(name=name, classes=classes, encoder=self._encoder_name, embedding=embedding)
        return remember(Path(memory), touch)

    def recognise(self, video: Video, memory: Path | str) -> Recognition:
        """Remembered objects, the most similar to a touch first.

        An object that was never remembered is most similar to one of them, too: a similarity is no probability.
        """
        encoded = self.touched(video)
        touches = recall(Path(memory), self._encoder_name)
        objects = most_similar(encoded.raw.mean(0).double().numpy(), touches)
        return Recognition(objects=objects, touches=len(touches), notes=self.notes(video))

    def reminded(self, question: str, videos: Sequence[Video], memory: Path | str) -> str:
        """The question with facts in front of it: of each video, name and classes of the remembered object that it is
        most similar to, in the sentence of a matching question: "soft, rough, no bumps is my rug. ..."."""
        nearest = [self.recognise(video, memory).objects[0] for video in videos]
        facts = dict.fromkeys(pom.sentence(known.classes, known.name) for known in nearest)
        return " ".join([*facts, with_marks(question, len(videos))])

    def scenario(self, question: str, videos: Sequence[Video]) -> Choice:
        """Which of two videos suits a situation better, described first where the variant describes."""
        if len(videos) != 2:
            raise UserError(f"{counted(len(videos), 'video')}: a situation chooses between two")
        aspects = " and ".join(p.spoken for p in self.catalogue.properties)
        history: list[Exchange] = []
        turns = psr.asked(question, aspects)[self.config.opd]
        for number, turn in enumerate(turns):
            shown = () if number else tuple(videos)
            said = self.ask(turn, shown, history=history, more=len(turns) > 1)
            history.append(Exchange(turn, shown, said))
        letter = psr.read(history[-1].answer)
        place = None if letter is None else LETTERS.index(letter)
        return Choice(question=question, answer=history[-1].answer, choice=place, notes=self.notes(videos))

    # ---- within ----

    def _language(self, max_new_tokens: int | None) -> LanguageConfig:
        language = self.config.language
        return language.model_copy(update={"max_new_tokens": max_new_tokens or language.max_new_tokens})

    def _reply(self, asked: Sequence[tuple[tuple[int, ...], torch.Tensor]], max_new_tokens: int | None) -> list[str]:
        prompts, features = [prompt for prompt, _ in asked], [found for _, found in asked]
        return [said.text for said in reply(self.llm, prompts, features, self._language(max_new_tokens), label="")]

    def _prompt(
        self,
        question: str,
        videos: Video | Sequence[Video],
        history: Sequence[Exchange] = (),
        *,
        untouched: bool = False,
        more: bool = False,
    ) -> tuple[tuple[int, ...], torch.Tensor]:
        """Token ids of a conversation whose last answer is to be said, and its frames' embeddings.

        Args:
            untouched: Lets a video pass in which nothing is touched.
            more: As `ask` has it.
        """
        if not self.config.speaks:
            raise UserError(f"{self.folder}: {MUTE}; use describe, rank or match")
        conversation = (*history, Exchange(question, _listed(videos), ""))
        turns = [Turn(user=with_marks(e.question, len(e.videos)), assistant=e.answer) for e in conversation]
        per_video, single = self.config.frames.per_video, len(turns) == 1 and not more
        prompt = write_prompt(turns, self.llm.tokenizer, self.config.language, per_video, single=single)
        positions = self.llm.positions
        if positions is not None and len(prompt) >= positions:
            raise UserError(
                f"the conversation takes {len(prompt)} tokens, but the language model reads {positions} with the "
                "answer; shorten the question, or begin a new conversation"
            )
        if not any(exchange.videos for exchange in conversation):
            raise UserError("the question comes without a video, so any touch would be made up; give one or more")
        features = [torch.zeros(0, self.llm.octopi_config.tactile_dim)]
        for video in (v for exchange in conversation for v in exchange.videos):
            encoded = self.encoder.encode(video) if untouched else self.touched(video)
            features.append(encoded.features)
        return prompt, torch.cat(features)

    def touched(self, video: Video) -> EncodedVideo:
        """A video as the model reads it; UserError where nothing touches the sensor."""
        encoded = self.encoder.encode(video)
        if not encoded.touched:
            raise UserError(f"{encoded.name}: {encoded.touch.notes[0]}; record the sensor being pressed")
        return encoded

    def _classes(self, video: Video) -> list[tuple[int, float]]:
        """The class and the expected class of each property, by the heads; without them by the model's sentence."""
        if not self.config.heads:
            named = self.describe(video).levels
            if lacking := [name for name in self.properties if name not in named]:
                raise UserError(f"{self.touched(video).name}: the model names no class of {lacking[0]}; ask it instead")
            return [
                (level, float(level)) for p in self.catalogue.properties for level in [p.levels.index(named[p.name])]
            ]
        found = self.encoder.classify(video)
        means = (sum(level * p for level, p in enumerate(each)) for each in found.probabilities)
        return list(zip(found.levels, means, strict=True))

    def _object(self, name: str, classes: Sequence[str] | None) -> Object:
        """The catalogue's object of that name or id; or one of these classes, in the order of the properties."""
        if classes is not None:
            levels = [p.levels for p in self.catalogue.properties]
            if len(classes) != len(levels) or any(c not in known for c, known in zip(classes, levels, strict=True)):
                raise UserError(f"{name} ({', '.join(classes)}): write a class of every property ({self._example()})")
            ratings = tuple((known.index(c),) for c, known in zip(classes, levels, strict=True))
            return Object(object_id=name.lower(), name=name, splits={}, ratings=ratings)
        known = {o.name.lower(): o for o in self.catalogue.objects.values()} | self.catalogue.objects
        for key in (name, name.lower()):
            if key in known:
                return known[key]
        hint = did_you_mean(name.lower(), known)
        raise UserError(
            f"{name}: the model's catalogue has no such object; {hint}write what each is like, one class of every "
            f"property ({self._example(name)}; ...)"
        )

    def _example(self, name: str = "NAME") -> str:
        return f"{name}: " + ", ".join("|".join(p.levels) for p in self.catalogue.properties)


def on_real_videos(folder: Path) -> str:
    """How many of real videos, which it was not trained on, a model describes right, by its card."""
    results = ModelCardData(ignore_metadata_errors=True, **front_matter(folder)).eval_results or []
    for r in results:
        if r.dataset_type == REAL and r.dataset_config == "OPD" and r.metric_args:
            told = {"value": r.metric_value, **r.metric_args}
            right, low, high, chance = (100 * told[key] for key in ("value", "low", "high", "chance"))
            return f"of real videos it describes {right:.1f} % [{low:.1f}, {high:.1f}] right (guessing {chance:.1f} %)"
    return "what it reaches on real videos was not measured"


def _listed(videos: Video | Sequence[Video]) -> tuple[Video, ...]:
    """One video as a list of one, and a folder as all of its videos."""
    if isinstance(videos, (str, os.PathLike)) and os.path.isdir(videos):
        return tuple(video_files(Path(videos))[0])
    alone = isinstance(videos, (str, os.PathLike)) or (isinstance(videos, np.ndarray) and videos.ndim == 4)
    return (videos,) if alone else tuple(videos)  # type: ignore[arg-type, return-value]


def with_marks(question: str, videos: int) -> str:
    """The question with "{tactile}" once for each video; where it has none at all, they stand in front, in order.

    Raises:
        UserError: where it is empty, marks more or fewer, or writes the tokens that stand for them.
    """
    if not question.strip():
        raise UserError("the question is empty; write one")
    if TACTILE not in question:
        question = " ".join([*[TACTILE] * videos, question])
    marks = question.count(TACTILE)
    if readable(question) != question:
        raise UserError("the question is no text in UTF-8; write it anew")
    if marks != videos:
        raise UserError(
            f"the question has {marks} {TACTILE} for {counted(videos, 'video')}; write one for each, in their order, "
            "or none"
        )
    for token in TACTILE_TOKENS:
        if token in question:
            raise UserError(
                f"the question has {token}, which stands for a touch itself; write {TACTILE} and give a video"
            )
    return question
