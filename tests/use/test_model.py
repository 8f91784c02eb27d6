"""A packaged model answers as the evaluation did, remembers touches, and refuses what it cannot answer in one line."""

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from pipeline.core.io import tensor_shapes
from pipeline.core.records import Encoder, Lora, Opd, Part, Variant
from pipeline.encoder.timm_backbone import STAGES
from pipeline.use import encoding
from pipeline.use import model as model_code
from pipeline.use.encoding import Classified, VideoEncoder
from pipeline.use.evaluate import use_onednn
from pipeline.use.frames import read_touch
from pipeline.use.memory import TOUCHES
from pipeline.use.model import Octopi
from tests.conftest import moving_square, refused, write_video
from tests.frame_rules import decode
from tests.use.shared import PARTS, Made, configured, make, replay

TUNED = ("encoder.recipe=tuned", "encoder.reference=subtract", "encoder.standardize=false")


def answers_as_stored(model: Octopi, made: Made) -> int:
    """Ask every other of the stored questions; how many were asked."""
    files = {f.stem: f for f in made.videos.iterdir()}
    return replay(model, made.questions, made.predictions[::2], made.variant.opd, files)


def test_its_answers_equal_the_stored_predictions(made: Made, octopi: Octopi) -> None:
    assert answers_as_stored(octopi, made) >= 25


def test_onednn_gives_the_same_answers(made: Made) -> None:
    model = Octopi.from_pretrained(made.folder, device="cpu")
    use_onednn(model.llm)
    names = [name for name, _ in model.llm.llm.named_parameters()]
    assert not [name for name in names if "lora_" in name or "q_proj" in name], "they are oneDNN's buffers now"
    assert answers_as_stored(model, made) >= 25


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "overrides"),
    [
        (Variant(Encoder.FINETUNED, Lora.WITHOUT, Opd.NONE, 0), (*TUNED, "encoder.backbone=[timm,scenes]")),
        (Variant(Encoder.BASE, Lora.WITH, Opd.ALL, 0), ("encoder.recipe=release", "frames.selection=contact")),
        (Variant(Encoder.BASE, Lora.WITH, Opd.NEEDED, 0), (*TUNED, "encoder.backbone=[clip,scenes]")),
    ],
    ids=["tuned", "release", "base of two backbones"],
)
def test_recipes(variant: Variant, overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = make(tmp_path, variant, *overrides)
    if "encoder.backbone=[timm,scenes]" in overrides:
        kept = tensor_shapes(made.folder / "encoder" / "backbone" / STAGES)
        whole = tensor_shapes(tmp_path / "clip" / "model.safetensors")
        assert kept.items() < whole.items(), "what follows the stage that is read stays behind"
    monkeypatch.chdir("/")
    assert answers_as_stored(Octopi.from_pretrained(made.folder, device="cpu"), made) >= 20


def test_heads_say_what_the_stage_stored(made: Made, octopi: Octopi) -> None:
    temperatures = octopi.config.temperatures
    assert any(t != 1 for t in temperatures.values())
    for c in made.classified:
        if c.part is Part.TEST:
            found = octopi.describe(made.videos / f"{c.video_id}.avi", sentence=False)
            power = np.array(c.probabilities) ** (1 / temperatures[c.property])
            given = list(found.probabilities[c.property].values())
            np.testing.assert_allclose(given, power / power.sum(), rtol=1e-4, atol=1e-7)
            assert list(found.probabilities[c.property]).index(found.levels[c.property]) == c.predicted


def test_a_batch_answers_as_one_by_one(octopi: Octopi, files: list[Path]) -> None:
    asked = [("Describe {tactile}.", [f]) for f in files]
    asked += [("Compare {tactile} and {tactile}.", files[:2])]
    assert octopi.ask_all(asked) == [octopi.ask(*a) for a in asked]
    described = octopi.describe_all(files)
    assert described == [octopi.describe(f) for f in files]
    assert [d.video for d in octopi.describe_all(files[0].parent)] == sorted(map(str, files[0].parent.iterdir()))
    assert all(d.sentence for d in described)
    short = octopi.describe_all(files, sentence=False)
    assert short == [d.model_copy(update={"sentence": ""}) for d in described]


def test_videos_decode_once(octopi: Octopi, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many there are, and however little of them is remembered; where they are, one call takes all."""
    reading = mock.Mock(wraps=read_touch)
    monkeypatch.setattr(encoding, "read_touch", reading)
    videos = [tmp_path / f"{i}.avi" for i in range(6)]
    for number, video in enumerate(videos):
        video.write_bytes(files[number % 3].read_bytes())
    octopi.ask_all([("Describe {tactile}.", video) for video in (*videos, *videos)], max_new_tokens=1)
    assert [call.args[0] for call in reading.mock_calls] == videos
    monkeypatch.setattr(encoding, "REMEMBERED", 0)
    octopi.look(files[0])
    for call in (octopi.describe_all, lambda given: octopi.rank(given, "hardness")):
        reading.reset_mock()
        call(videos)
        assert [call.args[0] for call in reading.mock_calls] == videos


def test_one_video_needs_no_list_and_an_array_is_as_its_file(octopi: Octopi, files: list[Path]) -> None:
    said = octopi.ask("Describe {tactile}.", files[:1])
    array = np.stack([frame[:, :, ::-1] for frame in decode(files[0])])
    assert octopi.ask("Describe {tactile}.", files[0]) == octopi.ask("Describe {tactile}.", str(files[0])) == said
    assert octopi.ask("{tactile} {tactile} Softer?", files[:2]) == octopi.ask("Softer?", files[:2]), "they go in front"
    assert octopi.ask("Describe {tactile}.", array) == octopi.ask("Describe {tactile}.", [array])
    file, other = octopi.look(files[0]), octopi.look(array)
    assert file.numbers == other.numbers
    assert np.abs(file.frames.astype(int) - other.frames).mean() < 2
    assert np.abs(file.reference.astype(int) - other.reference).mean() < 2


def test_look_shows_where_it_touches(octopi: Octopi) -> None:
    ground = np.full((20, 64, 64, 3), 90, np.uint8)
    touched = ground.copy()
    touched[8:, 24:40, 24:40] = np.arange(140, 200, 5)[:, None, None, None]
    touch = octopi.look(touched)
    assert touch.frames.shape == (3, 32, 32, 3)
    assert touch.contact == pytest.approx(1 / 16, rel=0.5)
    change = np.abs(touch.difference[-1].astype(int) - 128)
    assert change[:8].max() <= 4
    assert change[13:19, 13:19].min() > 50
    assert np.abs(touch.reference.astype(int) - 90).max() <= 2


def test_typed_tasks(octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    names = [octopi.catalogue.objects[o].name for o in ("rug", "baseball", "millet")]
    said = {
        "Is the object": "First object: it. Conclusion: No, the second object is harder.",
        "Given three tactile videos": "Conclusion: b) is the hardest.",
        "match": f"Conclusion: a) is {names[0]}, b) is {names[2]} and c) is {names[1]}.",
        "Given two": "none",
        "Describe these two": "a) soft. b) hard.",
        "I must sleep": "The most suitable object is b), because of its hardness.",
    }

    def answer(question: str, *_: object, **__: object) -> str:
        return next(text for start, text in reversed(said.items()) if start in question)

    # What the tasks make of any answer; that answers are the evaluation's is tested above.
    monkeypatch.setattr(octopi, "ask", ask := mock.Mock(side_effect=answer))
    compared = octopi.compare(files[0], files[1], "hardness")
    assert (compared.choice, compared.question.count("{tactile}")) == ("no", 2)
    ranked = octopi.rank(files, "Hardness")
    assert ranked.most == 1
    assert (model_code.APART in ranked.notes) == (ranked.order[-1] != 1)
    assert sorted(ranked.order) == [0, 1, 2]
    assert [ranked.expected[i] for i in ranked.order] == sorted(ranked.expected)
    said["Is the object"] = "Conclusion: Yes, the first object is softer."
    softer = octopi.compare(files[0], files[1], "softer")
    assert (softer.choice, "softer than" in softer.question) == ("yes", True)
    softest = octopi.rank(files[:2], "softest")
    assert (softest.order, softest.most) == (octopi.rank(files[:2], "hardness").order[::-1], 0)
    assert octopi.rank([*files, files[0]], "hardness").answer == ""
    matched = octopi.match(files, names)
    assert matched.names == (names[0], names[2], names[1])
    assert all(name in matched.question for name in names)
    said["match"] = f"Conclusion: a) is {names[0]} and b) is {names[2]}."
    two = octopi.match(files[:2], ["rug", names[2].upper()])
    assert (two.names, two.question.count("{tactile}")) == ((names[0], names[2]), 2)
    assert "it was trained to match three videos, not two" in two.notes
    # Objects of the caller's own, told in the heads' own words of each video: the heads must find them again.
    told = {f"thing {n}": tuple(octopi.describe(f, sentence=False).levels.values()) for n, f in enumerate(files)}
    said["match"] = "Conclusion: a) is thing 1, b) is thing 0 and c) is thing 2."
    own = octopi.match(files, dict(reversed(told.items())))
    assert [told[name] for name in own.heads] == list(told.values())
    assert all(f"{', '.join(classes)} is {name}." in own.question for name, classes in told.items())
    assert (model_code.APART in own.notes) == (own.heads != own.names)
    monkeypatch.setattr(octopi, "numbered", True)
    said["match"] = "Conclusion: a) is object 1, b) is object 3 and c) is object 2."
    numbered = octopi.match(files, names)
    assert numbered.names == matched.names
    assert not any(name in numbered.question for name in names)
    chosen = octopi.scenario("I must sleep.", files[:2])
    assert chosen.choice == 1
    assert [call.args[0].count("{tactile}") for call in ask.mock_calls[-2:]] == [2, 0], "described first"


ONE, TWO = (0.7, 0.2, 0.1), (0.2, 0.6, 0.2)
OVERALL = "Overall, it presents a {} and rough surface with big bumps."
SAYS = (
    # Class and probabilities of each video's hardness, a question, what follows; an answer that says it, and another.
    ([(0, ONE), (1, TWO)], "Which is softer?", "0.40.*1.00.*first object is softer", "So the first one.", "Both."),
    ([(0, ONE), (1, TWO)], "Is {tactile} harder than {tactile}?", "second object is harder", "No, it is not.", "Both."),
    ([(1, ONE), (1, TWO)], "Which is harder?", "0.40.*1.00.*Both objects are similar", "Both.", "The second is."),
    ([(0, ONE), (1, TWO), (1, ONE)], "Which is the hardest?", r"b\) is the hardest", "b) is the hardest.", "c)"),
    ([(0, TWO)], "How does it feel?", r"soft \(20%\)", OVERALL.format("soft"), OVERALL.format("hard")),
    ([(0, TWO)], "Is it softer?", None, "Yes.", "No."),
    ([(0, ONE), (1, TWO)], "Which is softer, or rougher?", None, "The first.", "The second."),
)


@pytest.mark.parametrize(("each", "question", "shown", "same", "other"), SAYS)
def test_what_the_heads_say_stands_beside_an_answer(
    each: Any, question: str, shown: str | None, same: str, other: str, octopi: Octopi, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {str(n): Classified((p, ONE, TWO), (level, 2, 2)) for n, (level, p) in enumerate(each)}
    monkeypatch.setattr(octopi.encoder, "classify", found.__getitem__)
    heads = octopi.verdict(question, [*found])
    assert (heads is None) == (shown is None)
    if heads and shown:
        assert re.search(shown, heads.shown)
        assert octopi.apart(other, heads) == (model_code.APART,)
    assert octopi.apart(same, heads) == octopi.apart("I cannot say.", heads) == ()


def test_two_ranked_are_two_compared(octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """A ranking has the comparison's notes, each once."""
    found = {file: Classified((p, ONE, TWO), (n, 2, 2)) for n, file, p in ((0, files[0], ONE), (1, files[1], TWO))}
    monkeypatch.setattr(octopi.encoder, "classify", found.__getitem__)
    monkeypatch.setattr(octopi, "doubts", ("a doubt",))
    for answer in ("Both objects are similar in hardness.", "Yes, the first object is harder."):
        monkeypatch.setattr(octopi, "ask", mock.Mock(return_value=answer))
        assert octopi.rank(files[:2], "hardness").notes == ("a doubt", model_code.APART)


def test_a_model_of_synthetic_touches_says_so_on_every_answer(octopi: Octopi, made: Made, files: list[Path]) -> None:
    synthetic = configured(octopi, made, trained_on="scenes")
    (note,) = synthetic.doubts
    assert "synthetic touches alone" in note
    assert "was not measured" in note, "its card has no figures of real videos"
    assert note in synthetic.describe(files[0], sentence=False).notes
    assert note in synthetic.compare(*files[:2], "hardness").notes
    shown = synthetic.verdict("How is it?", files[0])
    assert shown
    assert re.fullmatch(r"[^%]*score 0\.\d\d[^%]*", shown.shown)


def test_heads_without_temperatures_give_scores_and_no_doubt(octopi: Octopi, made: Made, files: list[Path]) -> None:
    published = configured(octopi, made, temperatures=dict.fromkeys(octopi.properties, 1.0))
    assert octopi.describe(files[0], sentence=False).calibrated
    assert not published.describe(files[0], sentence=False).calibrated
    assert published.config.share(0.5) == "score 0.50"
    assert published.doubts == ()


BUMPY = {"a mug": ("hard", "smooth", "bumpy"), "a rug": ("soft", "rough", "no bumps")}


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda model, files: model.ask("{tactile} is it softer?", files[:2]), r"1 \{tactile\} for 2 videos"),
        # Of a stream before the first piece is asked for.
        (lambda model, _: model.stream("Is it \udcff?"), "is no text in UTF-8"),
        (lambda model, _: model.ask("Is <tact_frame> soft?"), "<tact_frame>, which stands for a touch"),
        (lambda model, files: model.stream("long " * 1000, files[:1]), "begin a new conversation"),
        (lambda model, files: model.compare(*files[:2], "hardnes"), r"hardnes: .*did you mean hardness\? it knows"),
        (
            lambda model, files: model.match(files, ["rug", "millet", "a yo-yo"]),
            "a yo-yo: .*no such object; .*: soft",
        ),
        (lambda model, files: model.match(files[:2], BUMPY), r"NAME: soft\|moderately hard\|hard, .*no bumps"),
    ],
)
def test_what_does_not_fit_or_is_not_known_is_refused(
    ask: Callable[[Octopi, list[Path]], object], words: str, octopi: Octopi, files: list[Path]
) -> None:
    with refused(words):
        ask(octopi, files)


def test_videos_that_cannot_be_used_are_refused(octopi: Octopi, tmp_path: Path) -> None:
    (tmp_path / "text.avi").write_text("no video")
    one = write_video(tmp_path / "one.avi", moving_square(1))
    still = write_video(tmp_path / "still.avi", [np.full((36, 48, 3), 90, np.uint8)] * 12)
    arrays = [np.zeros((4, 3, 32, 32), np.uint8), np.zeros((0, 32, 32, 3), np.uint8), np.zeros((4, 32, 32, 3))]
    bad: list[tuple[Any, str]] = [
        (tmp_path / "text.avi", "no frame decodes"),
        (one, "show no touch"),
        (still, "nothing touches the sensor"),
        *((array, "is no video; give uint8") for array in arrays),
    ]
    for video, words in bad:
        name = f"^{re.escape(str(video))}" if isinstance(video, Path) else "^an? "
        with refused(f"{name}.*({words})"):
            octopi.ask("Describe {tactile}.", [video])
    assert any("nothing touches the sensor" in note for note in octopi.describe(still).notes)


def test_a_weak_and_a_damaged_video_are_noted(made: Made, octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    whole = files[0].read_bytes()
    (cut := tmp_path / "cut.avi").write_bytes(whole[: 2 * len(whole) // 3])
    assert any("damaged: only" in note for note in octopi.look(cut).notes)
    assert octopi.look(files[0]).notes == ()
    quiet = octopi.config.model_copy(update={"quiet": 0.8 * octopi.look(files[0]).strength})
    weak = VideoEncoder(made.folder, quiet, octopi.catalogue, octopi.encoder.device)
    assert [n.partition(":")[0] for n in weak.encode(files[0]).touch.notes] == ["little touches the sensor"]
    compared = octopi.compare(files[0], cut, "hardness")
    assert [n.partition(": ")[0] for n in compared.notes] == [str(cut)]
    assert "damaged" in compared.notes[0]


def test_a_model_on_random_weights_says_so(octopi: Octopi, made: Made, files: list[Path]) -> None:
    assert octopi.notes(files[:2]) == octopi.doubts == ()
    random = configured(octopi, made, base=octopi.config.base.model_copy(update={"folder": "data/weights/tiny-llama"}))
    assert random.notes(files[:1]) == random.describe(files[0]).notes == random.doubts
    assert "tiny and random" in random.doubts[0]
    assert repr(random).startswith("Octopi(finetuned-with-all-0, base data/weights/tiny-llama, trained on ")


def test_what_is_unlike_training_is_noted_and_no_training_video_is(octopi: Octopi, made: Made) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (12, 36, 48, 3), dtype=np.uint8)
    assert any("unlike training" in note for note in octopi.look(noise).notes)
    trained = [video for video in made.videos.iterdir() if PARTS[video.stem[:-2]] is not Part.TEST]
    assert not [note for video in trained for note in octopi.look(video).notes if "unlike" in note]


def test_a_remembered_touch_is_recognised_and_told(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    named, memory = dict(zip(("my ice", "my millet", "my towel"), files, strict=True)), tmp_path / "touches"
    assert [octopi.remember(name, file, memory) for name, file in named.items()] == [1, 2, 3]
    told = octopi.reminded("Which is softer?", files[:2], memory)
    ice, millet = (", ".join(octopi.recognise(file, memory).objects[0].classes) for file in files[:2])
    assert told == f"{ice} is my ice. {millet} is my millet. {{tactile}} {{tactile}} Which is softer?"
    assert octopi.ask("Which is softer?", files[:2], memory=memory) == octopi.ask(told, files[:2])
    for name, file in named.items():
        found = octopi.recognise(file, memory)
        assert (found.objects[0].name, found.touches, len(found.objects)) == (name, 3, 3)
        assert found.objects[0].similarity == pytest.approx(1, abs=1e-6)
        assert found.objects[0].classes == tuple(octopi.describe(file, sentence=False).levels.values())
    with ThreadPoolExecutor(4) as pool:
        counts = pool.map(lambda _: octopi.remember("my ice", files[1], memory), range(4))
    assert sorted(counts) == [4, 5, 6, 7], "none is lost"
    similar = octopi.recognise(files[0], memory).objects
    assert (similar[0].name, len(similar)) == ("my ice", 3), "an object is named once"
    assert similar[0].similarity == pytest.approx(1, abs=1e-6), "by its nearest touch"
    assert similar == tuple(sorted(similar, key=lambda s: -s.similarity))


def test_what_is_no_memory_is_refused_and_stays(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    memory = tmp_path / "touches"
    with refused("no memory of touches; `octopi remember"):
        octopi.recognise(files[0], memory)
    memory.mkdir()
    (memory / TOUCHES).touch()
    with refused("no memory of touches; `octopi remember"):
        octopi.recognise(files[0], memory)
    octopi.remember("my ice", files[0], memory)
    written = (memory / TOUCHES).read_text()
    still = np.full((20, 64, 64, 3), 90, np.uint8)
    with refused("press"):
        octopi.remember("nothing", still, memory)
    assert (memory / TOUCHES).read_text() == written
    for broken in (written[:-20].encode(), b"\xff" + written.encode()):
        (memory / TOUCHES).write_bytes(broken)
        with refused("touches.jsonl, line 1: is no touch .*; remove the line"):
            octopi.remember("my millet", files[1], memory)
    (memory / TOUCHES).write_text(written.replace('"encoder":"', '"encoder":"another'))
    for call in (lambda: octopi.recognise(files[0], memory), lambda: octopi.remember("a", files[1], memory)):
        with refused("another encoder's"):
            call()
