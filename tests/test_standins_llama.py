"""The stand-in Llama: what its texts teach and keep out, what its gate asks, and that its training resumes exactly."""

from __future__ import annotations

import random
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from transformers import AutoModelForCausalLM, AutoTokenizer

from pipeline.records import Opd, Prediction
from pipeline.tasks import TASKS
from pipeline.tasks.pom import fact
from standins.asking import comparisons, superlatives
from standins.conversing import FACTS, VIDEOS, Manner, asked_number, converse, draw_draft
from standins.curriculum import FORMATS, Format, compressed, phrases, repeat, vocabulary, wanted
from standins.describing import Style
from standins.documents import BLEND, UNKNOWN, Builder, Hint, blend_ids, tokenise
from standins.gate import Exam, answer, examine, exams, make_items, prompts
from standins.make_llama import make_model
from standins.matching import Reach, matching
from standins.settings import FOLDER, LlamaSettings, load_settings
from standins.training import Trainer, accuracies, embed, enlarge, pad
from standins.vocabulary import EOS, PAD, build_tokenizer, words_of
from standins.world import (
    ARTICLES,
    JOINTS,
    World,
    combinations,
    draw_fact,
    forbidden_descriptions,
    held_out_name,
    load_situations,
    make_world,
    misread,
    questions,
    real_catalogue,
    reworded,
    spare_words,
)
from tests.closure import closure

HELD_OUT = load_settings().llama.held_out
SMALL = load_settings().llama.model_copy(
    update={
        "hidden_size": 32,
        "intermediate_size": 48,
        "heads": 2,
        "layers": 3,
        "round_documents": 10,
        "check_rounds": 2,
        "check_questions": 3,
        "format_rounds": 3,
        "stall_rounds": 2,
        "decay_rounds": 3,
    }
)


@cache
def tokenizer() -> Any:
    return build_tokenizer(vocabulary(), phrases())


def a_world(rng: random.Random, *, held: bool = False, kind: Any = "training") -> World:
    return make_world(combinations(HELD_OUT, held=held), questions(kind), rng, held=held)


def corpus(seed: int, count: int) -> list[str]:
    rng = random.Random(seed)
    world = a_world(rng)
    return [f.write(world, rng).text for f in FORMATS for _ in range(count)]


def a_model(settings: LlamaSettings = SMALL) -> Any:
    torch.manual_seed(0)
    return make_model(settings, tokenizer())


def test_training_text_holds_nothing_of_the_evaluation() -> None:
    text = "\n".join(corpus(7, 150))
    assert not [s.question for s in real_catalogue().language.scenarios if s.question in text]
    assert not [d for d in forbidden_descriptions() if d in text]
    assert not set(combinations(HELD_OUT, held=False)) & set(HELD_OUT)
    asked = {s.question for s in questions("training")}
    assert not asked & {s.question for kind in ("seen", "unseen") for s in questions(kind)}  # type: ignore[arg-type]
    assert not [q for kind in ("seen", "unseen") for q in questions(kind) if q.question in text]  # type: ignore[arg-type]


def test_names_and_combinations_of_the_gate_are_never_trained_on() -> None:
    rng = random.Random(1)
    trained, tested = ([a_world(rng, held=held).catalogue for _ in range(20)] for held in (False, True))
    names, others = ({o.name for c in worlds for o in c.objects.values()} for worlds in (trained, tested))
    assert not names & others
    assert not names & {o.name for o in real_catalogue().objects.values()}
    labels, held = ({c.labels(o) for c in worlds for o in c.objects} for worlds in (trained, tested))
    assert not labels & held
    assert held == set(HELD_OUT)
    situations = load_situations()
    share = sum(held_out_name(a, n) for a in situations.adjectives for n in situations.nouns)
    assert 0.1 < share / len(situations.adjectives) / len(situations.nouns) < 0.25


def test_every_word_of_the_catalogues_names_is_one_that_training_copies() -> None:
    copied = {*spare_words(), *words_of((*JOINTS, *ARTICLES))}
    assert not words_of(o.name for o in real_catalogue().objects.values()) - copied
    rng = random.Random(15)
    names = (o.name for _ in range(100) for o in a_world(rng).catalogue.objects.values())
    assert set(spare_words()) <= words_of(names)


def test_the_stand_in_can_say_every_name_of_the_catalogue() -> None:
    """Each at least once in up to eight matchings that ask for it, with the facts told."""
    model = AutoModelForCausalLM.from_pretrained(FOLDER / "llama", dtype=torch.float32).eval()
    tokens = AutoTokenizer.from_pretrained(FOLDER / "llama")
    items = make_items(next(e for e in exams() if e.objects == "all"), load_settings().llama)
    objects = real_catalogue().objects
    unsaid = set(objects)
    for _ in range(8):
        chosen, wanted = [], set(unsaid)
        for item in items:
            if wanted & set(item.question.objects):
                wanted -= set(item.question.objects)
                chosen.append(item)
        items = [item for item in items if item not in chosen]
        said = answer(model, tokens, prompts(chosen, [() for _ in chosen]), [() for _ in chosen])
        for item, text in zip(chosen, said, strict=True):
            unsaid -= {o for o in item.question.objects if objects[o].name in text}
    assert not unsaid


def test_unseen_kinds_are_told_as_facts_only() -> None:
    rng = random.Random(2)
    told = {draw_fact(rng).opening.lower() for _ in range(4000)}
    for scenario in questions("unseen"):
        assert any(scenario.name.lower() in opening for opening in told), scenario.name
        assert not [q for q in questions("training") if scenario.name in q.question]


def test_facts_name_the_class_that_situations_ask_for() -> None:
    rng = random.Random(3)
    asked = {s.name: s for kind in ("training", "unseen") for s in questions(kind)}  # type: ignore[arg-type]
    properties = real_catalogue().properties
    for _ in range(200):
        fact = draw_fact(rng)
        (scenario,) = [s for name, s in asked.items() if name in fact.opening[0].lower() + fact.opening[1:]]
        prop = properties[fact.asked // 2]
        assert scenario.target == {prop.name: (0 if fact.asked % 2 else len(prop.levels) - 1,)}
        assert fact.word.strip() == prop.levels[scenario.target[prop.name][0]]


def test_a_draft_of_every_task_can_be_drawn_from_the_held_out_combinations() -> None:
    rng = random.Random(4)
    world = a_world(rng, held=True, kind="seen")
    for task in TASKS:
        assert any(d.opd == Opd.ALL for d in draw_draft(world, task, rng).dialogues)


@pytest.mark.parametrize("exam", exams(), ids=lambda exam: exam.name)
def test_the_right_answers_of_every_row_pass_its_grader_and_others_fail(exam: Exam) -> None:
    items = make_items(exam, load_settings().llama.model_copy(update={"gate_questions": 12}))
    verdicts = []
    for item, prompt in zip(items, prompts(items, [[t.assistant for t in i.turns[:-1]] for i in items]), strict=True):
        assert prompt.endswith(item.given or "ASSISTANT:")
        assert prompt.count(PAD) == BLEND.count(PAD) * len(item.blends)
        said = item.turns[-1].assistant
        assert not item.given or said.startswith(item.given.strip())
        rest = said.removeprefix(item.given.strip()).strip()
        for text in (rest, "Something else."):
            name = item.question.question_id
            outputs = (*(t.assistant for t in item.turns[:-1]), text)
            prediction = Prediction(question_id=name, task=exam.task, outputs=outputs, truncated=False, tokens=1)
            scores = TASKS[exam.task].grade(item.question, prediction, item.catalogue)
            verdicts.append(next(s.correct for s in scores if s.measure == exam.measure))
    assert verdicts == [True, False] * len(items)


def test_gate_rows_of_test_objects_show_their_own_sentences() -> None:
    settings = load_settings().llama.model_copy(update={"gate_questions": 5})
    for exam in exams():
        for item in make_items(exam, settings):
            sentences = [item.catalogue.unstructured(o) for o in item.question.objects]
            if exam.objects != "made up":
                # With two turns the descriptions are the first answer.
                shown = item.turns[0].assistant if len(item.turns) > 1 else item.given
                assert all(sentence in shown for sentence in sentences)
                assert ("Overall" in shown) == (exam.objects != "test, own sentence alone")


def test_a_conversation_is_the_pipelines_own_text() -> None:
    rng = random.Random(5)
    world = a_world(rng)
    for task in TASKS:
        for mode in Opd:
            if task == "OPD" and mode == Opd.NONE:
                continue
            text = converse(world, task, mode, rng, Manner()).text
            assert text.startswith("USER: ")
            assert text.endswith(EOS)
            assert not set(VIDEOS + FACTS) & set(text)
            blended = converse(world, task, mode, rng, Manner(slots=True, blended=True))
            assert blended.text.count(BLEND) == sum(bool(p.blend) for p in blended.pieces) > 0


def test_what_is_asked_is_read_from_every_question() -> None:
    rng = random.Random(6)
    world = a_world(rng)
    catalogue = world.catalogue
    for task in ("PC", "PSS", "PSR"):
        seen = set()
        for _ in range(300):
            draft = draw_draft(world, task, rng)
            text = draft.dialogues[0].turns[-1].user
            number = asked_number(world, task, text)
            assert catalogue.property_names[number // 2] in draft.gold.properties, text
            seen.add(number)
        assert seen == set(range(2 * len(catalogue.properties)))
    assert asked_number(world, "POM", "Match them.") == UNKNOWN


def test_hints_stand_where_everything_they_tell_has_been_said() -> None:
    rng = random.Random(8)
    world = a_world(rng)
    tokens = tokenizer()
    for text in FORMATS:
        for document in tokenise([text.write(world, rng) for _ in range(20)], tokens):
            assert len(document.ids) == len(document.weights) == len(document.decisions) == len(document.hints)
            assert set(document.decisions) - {-1} == set(document.kinds)
            for at, hint in enumerate(document.hints):
                before = tokens.decode(document.ids[: at + 1])
                if hint.labels and not any(place <= at for place, _ in document.blends):
                    for prop, level in zip(world.catalogue.properties, hint.labels, strict=True):
                        words = () if level == UNKNOWN else (prop.levels[level], *prop.phrases[level])
                        assert level == UNKNOWN or any(word in before for word in words), before


def test_questions_about_labels_agree_with_the_graders_own() -> None:
    world = a_world(random.Random(9))
    low, high = (0, 0, 0), (2, 0, 1)
    said = {a.word: (a.verdict, a.number) for a in comparisons(world, [low, high])}
    assert said["harder"] == ("No, the second object is harder.", 0)
    assert said["softer"] == ("Yes, the first object is softer.", 1)
    assert said["rougher"] == ("Both objects have the same roughness.", 2)
    best = {a.word: (a.verdict, a.number) for a in superlatives(world, [low, high, low])}
    assert best == {"hardest": ("b) is the hardest.", 0), "bumpiest": ("b) is the bumpiest.", 4)}


def test_matching_names_each_object_by_its_fact() -> None:
    rng = random.Random(10)
    world = a_world(rng)
    by_name = {o.name: o.labels for o in world.catalogue.objects.values()}
    for reach in Reach:
        document = matching(world, Style.STRUCTURED, reach, rng)
        decided = [p.text.strip() for p in document.pieces if p.decision]
        assert len(decided) == len(set(decided)) == 3
        for before, piece in zip(document.pieces, document.pieces[1:], strict=False):
            if piece.decision:
                assert (before.hint.labels or before.hint.recalled) == by_name[piece.text.strip()]


def test_what_is_felt_wrongly_still_fits_best_and_alone() -> None:
    """Against scipy's assignment: any other way to tell the three apart costs more."""
    rng = random.Random(12)
    for _ in range(20):
        world = a_world(rng)
        known = {world.catalogue.labels(o) for o in world.pool.objects}
        objects = draw_draft(world, "POM", rng).objects
        felt = misread(world, objects, rng).catalogue
        truth, read = ([c.labels(o) for o in objects] for c in (world.catalogue, felt))
        costs = cdist(np.array(read), np.array(truth), "cityblock")
        _, best = linear_sum_assignment(costs)
        assert list(best) == [0, 1, 2]
        for cell in range(3):
            dearer = costs.copy()
            dearer[cell, cell] += 0.5
            assert list(linear_sum_assignment(dearer)[1]) == [0, 1, 2]
        assert known.issuperset(read)
        assert read != truth
        others = set(world.pool.objects) - set(objects)
        assert all(felt.labels(o) == world.catalogue.labels(o) for o in others)


def test_matching_by_likeness_tells_what_is_and_describes_what_is_felt() -> None:
    rng = random.Random(13)
    wrong = 0
    for _ in range(30):
        world = a_world(rng)
        catalogue = world.catalogue
        text = converse(world, "POM", Opd.ALL, rng, Manner(facts=True, misread=True)).text
        conclusion = text.rpartition("Conclusion:")[2]
        ends = (", b) is", " and c) is", ".</s>")
        objects = [
            o for o in catalogue.objects if any(f" is {catalogue.objects[o].name}{e}" in conclusion for e in ends)
        ]
        assert len(objects) == 3
        assert all("".join(fact(catalogue, o)) in text for o in objects)
        wrong += sum(catalogue.structured(catalogue.labels(o)) not in text for o in objects)
    assert wrong > 20


def test_random_wordings_hold_the_situation_and_no_wording_of_the_gate() -> None:
    rng = random.Random(14)
    world = a_world(rng)
    asked = {s.name for s in questions("training")}
    for _ in range(20):
        scenarios = reworded(world, rng).catalogue.language.scenarios
        assert {s.name for s in scenarios} == asked
        assert all(s.name in s.question for s in scenarios)
    opening = load_situations().held_out_opening.partition("{")[0]
    assert not [text for text in (wanted(world, rng).text for _ in range(500)) if opening in text]


def test_blends_are_sums_of_the_words_embeddings() -> None:
    tokens, model = tokenizer(), a_model()
    words = [p.levels[0] for p in real_catalogue().properties]
    builder = Builder("x").given("USER:").blended(words, Hint()).given(" hard")
    (document,) = tokenise([builder.build()], tokens)
    ids, _ = pad([document])
    embeddings = embed(model, ids, [document])[0]
    matrix = model.get_input_embeddings().weight
    wanted = matrix[[tokens(f" {w}", add_special_tokens=False)["input_ids"][0] for w in words]].sum(0)
    first = document.ids.index(tokens.pad_token_id)
    torch.testing.assert_close(embeddings[first + 1 : first + 6], wanted.expand(5, -1))
    assert not embeddings[[first, first + 6]].any()
    torch.testing.assert_close(embeddings[-1], matrix[document.ids[-1]])
    assert blend_ids(words, tokens)[1] == tuple(
        tokens(f" {w}", add_special_tokens=False)["input_ids"][0] for w in words
    )


@pytest.mark.parametrize(("stage", "script"), [("llama", "make_llama"), ("gate", "gate")])
def test_stages_name_the_recipes_modules(stage: str, script: str) -> None:
    named = yaml.safe_load((FOLDER / "dvc.yaml").read_text(encoding="utf-8"))["stages"][stage]["deps"]
    reached = closure(FOLDER / f"{script}.py")
    own = {m for m in reached if m.startswith("standins/") and not m.endswith("__init__.py")}
    assert own == {d for d in named if d.startswith("standins/") and d.endswith(".py")}
    # Of the pipeline's modules those that hold words decide about the text.
    assert {m for m in reached if m.startswith("pipeline/tasks/") and not m.endswith("__init__.py")} <= set(named)
    assert all((FOLDER.parent / d).exists() for d in named)


class Killed(Exception):
    pass


FEW = (Format("compressed", compressed, ("PC", "PSS")), Format("repeat", repeat, ("repetition",)))


def trainer(folder: Path | None, mark: str = "m") -> Trainer:
    return Trainer(a_model(), tokenizer(), SMALL, FEW, folder, mark)


@pytest.mark.parametrize("after", [1, 3, 4])
def test_a_killed_training_ends_with_the_same_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    whole = trainer(None)
    whole.learn()
    killed, round_, rounds = trainer(tmp_path), Trainer._round, iter(range(after))

    def dying(*arguments: Any) -> None:
        if next(rounds, None) is None:
            raise Killed
        round_(*arguments)

    monkeypatch.setattr(Trainer, "_round", dying)
    with pytest.raises(Killed):
        killed.learn()
    monkeypatch.undo()
    again = trainer(tmp_path)
    assert again.resume() == (after > 1)
    again.learn()
    assert again.curve == whole.curve
    for name, tensor in whole.model.state_dict().items():
        assert torch.equal(again.model.state_dict()[name], tensor), name


def test_a_checkpoint_of_another_recipe_is_passed_over(tmp_path: Path) -> None:
    first = trainer(tmp_path)
    first.steps = 7
    first.save()
    assert not trainer(tmp_path, "other").resume()
    other = trainer(tmp_path, "other")
    assert other.resume(tmp_path / "last.pt")
    assert other.steps == 7


def test_probes_read_the_middle_and_are_not_stored() -> None:
    from safetensors import safe_open

    with safe_open(FOLDER / "llama" / "model.safetensors", "pt") as stored:
        names = set(stored.keys())
    settings = load_settings().llama
    model = make_model(settings, tokenizer())
    assert names == set(model.state_dict()) - {"lm_head.weight"}
    run = trainer(None)
    batch = next(run._batches(FEW[0], ()))
    ids, _ = pad(batch)
    with torch.no_grad():
        hidden = run.model.model(input_ids=ids, output_hidden_states=True).hidden_states
    words = run.model.get_input_embeddings().weight
    assert run.probes(hidden, batch, words).item() > 0
    assert run.probes(hidden, [], words).item() == 0


def test_enlarging_the_words_leaves_the_logits_about_the_same() -> None:
    run = trainer(None)
    ids = torch.arange(300, 340)[None]
    batch = next(run._batches(FEW[0], ()))
    run._step(batch, 1.0)
    with torch.no_grad():
        before = run.model(input_ids=ids).logits
        size = run.model.get_input_embeddings().weight.norm()
        enlarge(run.model, run.optimiser, 1.5)
        after = run.model(input_ids=ids).logits
    torch.testing.assert_close(run.model.get_input_embeddings().weight.norm(), 1.5 * size)
    # The residual stream holds more of the word itself; nothing else has changed.
    assert torch.nn.functional.cosine_similarity(before.flatten(), after.flatten(), dim=0) > 0.9
    run._step(batch, 1.0)
    assert all(torch.isfinite(p).all() for p in run.model.parameters())


def test_accuracy_counts_whole_decisions() -> None:
    model, tokens = a_model(), tokenizer()
    documents = [Builder("a").given("USER:").decided(" hard").build(), Builder("b").decided(" soft", kind="c").build()]
    reached = accuracies(model, tokenise(documents, tokens), 64)
    assert set(reached) == {"a", "c"}
    assert all(0 <= share <= 1 for share in reached.values())


def test_left_padding_changes_no_answer_of_the_gate() -> None:
    model = a_model().eval()
    texts = ["USER: How does this feel? ASSISTANT:", "USER: Which one is the hardest of all these? ASSISTANT:"]
    together = answer(model, tokenizer(), texts, [(), ()])
    assert together == [answer(model, tokenizer(), [text], [()])[0] for text in texts]


def test_an_exam_counts_right_answers() -> None:
    settings = SMALL.model_copy(update={"gate_questions": 3})
    row, graded = examine(a_model().eval(), tokenizer(), exams()[0], settings)
    assert row[0] == "PC"
    assert row[4] == len(graded) == 3
    assert row[6] == "no"
