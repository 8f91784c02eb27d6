"""The model that is shipped: whole, small, found from anywhere, and not random."""

import re
import runpy
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
import yaml
from huggingface_hub import metadata_load
from safetensors.torch import load_file
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.config import LANGUAGE_DIR
from pipeline.config.params import load_params
from pipeline.core.io import read_json, read_table, write_table
from pipeline.core.layout import SHIPPED
from pipeline.core.records import Part, Question
from pipeline.evaluation.records import GradedVision, Shown
from pipeline.evaluation.rows import ALL_SEEDS
from pipeline.language.base import ADAPTER_CONFIG, ADAPTER_WEIGHTS
from pipeline.language.generate import answer
from pipeline.report.load import load_report, published
from pipeline.report.tables import measured
from pipeline.running.errors import UserError
from pipeline.scales import compose, write_params
from pipeline.use import folder
from pipeline.use.adapt import adapt
from pipeline.use.evaluate import after_ratings, answers_about, answers_after_ratings, check_rated
from pipeline.use.folder import Base, find_base, read_folder
from pipeline.use.model import REAL, Octopi, on_real_videos
from pipeline.use.results import Description
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Video
from tests.checkpoints import model_folder
from tests.conftest import CATALOGUE, ROOT, fake_videos

EXAMPLES = ROOT / "examples"
LARGEST, RANK, VIDEO = 40e6, 32, 200_000
RUN = ("params.yaml", "dvc.lock")
"""Of the run that made it."""


def test_it_is_whole_and_small() -> None:
    """`read_folder` compares every file with its hash."""
    config, catalogue = read_folder(SHIPPED)
    files = [f for f in SHIPPED.rglob("*") if f.is_file()]
    assert {f.relative_to(SHIPPED).as_posix() for f in files} == {*config.files, "config.json", "README.md", *RUN}
    assert sum(f.stat().st_size for f in files) <= LARGEST
    adapter = SHIPPED / LANGUAGE_DIR / "adapter"
    assert read_json(adapter / ADAPTER_CONFIG)["r"] <= RANK
    assert {t.dtype for t in load_file(adapter / ADAPTER_WEIGHTS).values()} == {torch.bfloat16}
    assert catalogue.property_names == ("hardness", "roughness", "bumpiness")
    written = "".join(f.read_text(encoding="utf-8") for f in files if f.suffix in (".md", ".json"))
    assert not re.search(r"[\"'\s(`]/\w+/", written), "no path of a machine"


def test_the_documented_command_is_that_of_its_run() -> None:
    document = (ROOT / "docs" / "use.md").read_text(encoding="utf-8").replace("\\\n", "")
    (command,) = re.findall(r"^octopi scale (invented .*)$", document, re.MULTILINE)
    scale, *overrides = shlex.split(command)
    params = compose(scale, overrides, conf=ROOT / "conf")
    assert load_params(SHIPPED / RUN[0]) == params
    config, _ = read_folder(SHIPPED)
    assert (config.frames, config.encoder, config.language) == (params.frames, params.encoder, params.language)
    stages = yaml.safe_load((SHIPPED / RUN[1]).read_text(encoding="utf-8"))["stages"]
    own = yaml.safe_load((SHIPPED / RUN[0]).read_text(encoding="utf-8"))
    for name, stage in stages.items():
        for key, value in stage.get("params", {}).get(RUN[0], {}).items():
            assert reduce(lambda found, part: found[part], key.split("."), own) == value, (name, key)
    assert {"invent", "pretrain", "finetune_encoder@0", "lora@finetuned-all-0", "package"} <= {*stages}


def test_its_figures_are_those_of_its_card() -> None:
    config, _ = read_folder(SHIPPED)
    assert set(config.scores) == {"OPD", "PC", "PSS", "POM", "PSR"}
    scores = {t: f"{100 * x:.1f} [{100 * low:.1f}, {100 * high:.1f}]" for t, (x, low, high) in config.scores.items()}
    own, _, real = (SHIPPED / "README.md").read_text(encoding="utf-8").partition("## Scores on real videos")
    card = re.findall(r"\(([A-Z]+)\) \| \d+ \| (\S+ \[.*?\])", own)
    assert dict(card) == scores
    # Those on real videos are the report's, in the table, in its front matter, and in the note of every answer.
    rows = load_report(ROOT / "reports" / "small-videos").scores.query(
        f"encoder == 'octopi-small' and seed == {ALL_SEEDS!r} and measure in ['choice', 'combined']"
    )
    index = metadata_load(SHIPPED / "README.md")["model-index"][0]["results"]
    front = {r["dataset"]["config"]: r["metrics"][0] for r in index if r["dataset"]["type"] == REAL}
    for task in config.scores:
        model, rules = (dict(rows[(rows.task == task) & (rows.touch == t)].iloc[0]) for t in ("touch", "classes"))
        assert f"({task}) | {model['n']} | {measured(model)} | {measured(rules)} | {100 * model['chance']:.1f}" in real
        assert front[task]["value"] == model["accuracy"]
        assert front[task]["args"] == {key: model[key] for key in ("low", "high", "chance", "n")}
        if task == "OPD":
            assert f"{100 * model['accuracy']:.1f} % [{100 * model['low']:.1f}, " in on_real_videos(SHIPPED)


def test_the_documents_tables_are_those_of_the_report() -> None:
    """README, and the learning curve: the language model / heads and rules, by how many real objects were rated."""
    readme, data = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/data.md"))
    assert ("**Never run here**: the paper's own models" in readme) != any(
        (ROOT / "reports").glob("paper-*/scores.csv")
    )
    choice = "measure in ['choice', 'combined']"
    found = load_report(ROOT / "reports" / "small-videos").scores.query(f"seed == {ALL_SEEDS!r} and {choice}")
    scores = found[found["opd"].isin(["all", ""])].set_index(["task", "encoder", "lora", "touch"])
    full = "model == '7b' and encoder == 'finetuned' and lora == 'with' and opd == 'all'"
    theirs = published().query(f"{full} and {choice}").set_index("task")["value"]

    def cell(task: str, rated: int | None) -> str:
        if rated is None:
            model, rules = (dict(scores.loc[(task, "finetuned", lora, "real")]) for lora in ("with", ""))
        else:
            name = after_ratings(SHIPPED.name, rated)
            model, rules = (dict(scores.loc[(task, name, "", shown)]) for shown in ("touch", "classes"))
        return f"{measured(model)} / {100 * rules['accuracy']:.1f}"

    def short(task: str, rated: int | None) -> str:
        return re.sub(r" \[.*\]", "", cell(task, rated))

    tasks = ("OPD", "PC", "PSS", "POM", "PSR")
    for count in (0, 3, 5, 10, 20, 38):
        cells = (cell if task == "OPD" else short for task in tasks)
        row = " | ".join(tell(task, count) for tell, task in zip(cells, tasks, strict=True))
        assert f"\n| {count or 'none'} | {row} |\n" in data
    as_it_is = (scores.loc[("OPD", SHIPPED.name, "", shown), "accuracy"] for shown in ("touch", "classes"))
    assert f"describes {' / '.join(f'{100 * share:.1f}' for share in as_it_is)} % right" in readme
    trained = load_report(ROOT / "reports" / "small-videos").effects.query("part == 'training'").set_index("task")
    points, low, high = (f"{100 * trained.loc['OPD', key]:.1f}" for key in ("difference", "low", "high"))
    told = f"{points} points better [{low}, {high}], its heads no better, and in no task was it surely ahead"
    assert told in " ".join(data.split())
    assert (trained["low"] < 0).all()
    both = ("finetuned", "", "real"), (after_ratings(SHIPPED.name, 38), "", "classes")
    trained_heads, adapted_heads = (scores.loc[("OPD", *key), "accuracy"] for key in both)
    assert trained_heads <= adapted_heads
    lines = readme.partition("\n| | No ratings |")[2].splitlines()[2:7]
    for task, line in zip(tasks, lines, strict=True):
        told = [*(short(task, count) for count in (0, 10, 38)), cell(task, None)]
        chance = scores.loc[(task, "finetuned", "with", "real"), "chance"]
        told += [f"{100 * chance:.1f}", f"{theirs[task]:.1f}"]
        assert [part.strip() for part in line.strip("|").split("|")][1:] == told
        assert task not in line.split("|")[1], "in words"


def test_its_llm_is_made_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cached = tmp_path / "cache" / "octopi" / "smollm2"

    def make(name: str, to: Path) -> None:
        assert (name, to) == ("smollm2", cached)
        to.mkdir(parents=True)  # Which fails where it is made again.
        (to / "model.safetensors").write_bytes(b"weights")

    monkeypatch.setattr(folder, "make", make)
    monkeypatch.chdir(tmp_path)
    known = Base(folder="data/weights/smollm2", files={"model.safetensors": sha256(b"weights").hexdigest()})
    assert find_base(tmp_path / "model", known) == (cached, ())
    assert "smollm2 is made of an installed package" in caplog.text
    assert find_base(tmp_path / "model", known) == (cached, ())


@pytest.fixture(scope="module")
def octopi(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Octopi]:
    """With its language model in the user's cache, as where it has been made."""
    folder = tmp_path_factory.mktemp("cache")
    (folder / "octopi").mkdir()
    (folder / "octopi" / "smollm2").symlink_to(model_folder("smollm2"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield Octopi.from_pretrained(dtype="float32")


@pytest.mark.slow
def test_it_tells_touches_apart_from_any_folder(
    octopi: Octopi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    soft, hard, rough = (EXAMPLES / f"{name}.mp4" for name in ("soft", "hard", "rough"))
    assert max(f.stat().st_size for f in EXAMPLES.glob("*.mp4")) <= VIDEO
    question = "Which is softer? {tactile} {tactile}"
    monkeypatch.chdir(tmp_path)
    said = CliRunner().invoke(app, ["ask", question, str(soft), str(hard)])
    assert "octopi-small answers" in caplog.text
    assert re.search(r"the first object is softer", said.stdout, re.IGNORECASE), said.output
    assert re.search(r"the second object is softer", octopi.ask(question, [hard, soft]), re.IGNORECASE)
    told = {"a tile": "hard, smooth, no bumps", "a rug": "soft, rough, no bumps", "a bun": "soft, smooth, small bumps"}
    matched = octopi.match([soft, hard, rough], {name: classes.split(", ") for name, classes in told.items()})
    assert matched.heads == ("a bun", "a tile", "a rug")
    assert "a) is a bun" in matched.answer, "its language model gets half of such questions right, not each"


def as_described(graded: Sequence[GradedVision], said: Mapping[str, Description]) -> None:
    """What was graded of the hardness of each object is what is said of its video."""
    for row in graded:
        if row.measure == "hardness" and row.shown is Shown.CLASSES:
            assert row.predicted == said[row.objects[0]].levels["hardness"]
        elif row.measure == "hardness" and row.shown is Shown.TOUCH:
            assert f" {row.predicted} " in said[row.objects[0]].sentence


@pytest.mark.slow
def test_a_runs_videos_are_asked_about(octopi: Octopi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it says of them is what it says to a person who asks; an object that it was trained on stops the stage."""
    changed = ["data.source=videos", f"data.dir={EXAMPLES}", f"data.catalogue={ROOT}/pipeline/physiclear"]
    changed += ["kernels=machine", "evaluate.questions=4", "evaluate.repeats=2"]
    changed += ["questions.evaluation={opd:9,pc:9,pss:0,pom:9,psr:0}"]
    write_params(compose("smoke", changed, ROOT / "conf"), tmp_path / "params.yaml")
    monkeypatch.chdir(tmp_path)
    # Two threads of each of two test processes would wait for each other on two cores.
    monkeypatch.setattr("pipeline.core.runtime.limit_threads", lambda _: None)

    def run(objects: dict[str, str]) -> list[GradedVision]:
        videos = fake_videos(objects, per_object=1)
        videos = [v.model_copy(update={"path": f"{objects[v.object_id]}.mp4"}) for v in videos]
        write_table(tmp_path / "data" / "videos.parquet", Video, videos)
        unused = [Assignment(video_id=v.video_id, object_id=v.object_id, part=Part.UNUSED) for v in videos]
        write_table(tmp_path / "data" / "splits" / "0.parquet", Assignment, unused)
        runpy.run_path(str(ROOT / "stages" / "evaluate.py"), run_name="__main__")
        return read_table(tmp_path / "data" / "evaluated.parquet", GradedVision)

    put: list[Question] = []
    monkeypatch.setattr("pipeline.use.evaluate.answer", lambda *given: put.extend(given[2]) or answer(*given))
    graded = run(objects := {"pillow": "soft", "baseball": "hard", "steel_wool": "rough"})
    ways = {way: [(r.question_id, r.measure) for r in graded if r.shown is way] for way in Shown}
    assert ways[Shown.TOUCH] == ways[Shown.CLASSES]
    sets = [{r.question_id for r in graded if r.seed == seed} for seed in (0, 1)]
    assert len(sets[0]) == len(sets[1]) == len(sets[0] | sets[1]) / 2, "no question of one set is in the other"
    asked = {r.question_id: r.task for r in graded if r.seed == 0}
    assert Counter(asked.values()) == {"OPD": 2, "PC": 1, "POM": 1}, "half of them describe"
    named = [q.model_dump_json() for q in put if q.task == "POM"]
    assert named
    assert all(re.search(r"object \d", text) for text in named), "it is asked under names as in training"
    said = dict(zip(objects, octopi.describe_all([EXAMPLES / f"{v}.mp4" for v in objects.values()]), strict=True))
    as_described(graded, said)
    with pytest.raises(SystemExit, match=r"evaluate.models: octopi-small was trained on object_\S+, which"):
        run({next(iter(octopi.catalogue.objects)): "soft"})


@pytest.mark.slow
def test_after_ratings_it_answers_as_its_copy(octopi: Octopi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """About test objects alone, whose ratings it never had; without ratings by the training videos alone."""
    monkeypatch.setattr("pipeline.core.runtime.limit_threads", lambda _: None)
    changed = [f"data.dir={EXAMPLES}", f"data.catalogue={ROOT}/pipeline/physiclear", "data.source=videos"]
    few = ["kernels=machine", "questions.evaluation={opd:9,pc:0,pss:0,pom:0,psr:0}"]
    params = compose("smoke", [*changed, *few], ROOT / "conf")
    files = {"rug": "soft", "pillow": "soft", "baseball": "hard", "steel_wool": "rough"}
    videos = [v.model_copy(update={"path": f"{files[v.object_id]}.mp4"}) for v in fake_videos([*files], per_object=1)]
    parts = {"rug": Part.TRAIN, "baseball": Part.TRAIN}
    split = [
        Assignment(video_id=v.video_id, object_id=v.object_id, part=parts.get(v.object_id, Part.TEST)) for v in videos
    ]
    own = [EXAMPLES / f"{files[name]}.mp4" for name in parts]
    for count, ratings in ((0, None), (2, CATALOGUE)):
        graded = answers_after_ratings(octopi, params, videos, split, 0, count)
        assert {r.model for r in graded} == {f"octopi-small, adapted by {count}"}
        assert {r.objects for r in graded} == {("pillow",), ("steel_wool",)}
        to = tmp_path / str(count)
        adapt(octopi, own, to, catalogue=ratings, objects=[*parts])
        copy = Octopi.from_pretrained(to, dtype="float32")
        as_described(graded, {name: copy.describe(EXAMPLES / f"{video}.mp4") for name, video in files.items()})
    check_rated([], {0: split})
    check_rated([0, 2], {0: split})
    with pytest.raises(UserError, match=r"evaluate.rated: 3 objects, but seed 1 trains on 2"):
        check_rated([0, 3], {1: split})


@pytest.mark.parametrize("update", [{"name": "warmth"}, {"levels": ("yielding", "springy", "rigid")}])
def test_it_is_not_asked_about_properties_or_classes_of_others(
    update: dict[str, Any], catalogue: Catalogue, caplog: pytest.LogCaptureFixture
) -> None:
    first, *rest = catalogue.properties
    known = SimpleNamespace(classes={p.name: p.levels for p in (first.model_copy(update=update), *rest)})
    model = SimpleNamespace(catalogue=known, numbered=True, name="octopi-small")
    params = compose("smoke", ["evaluate.questions=4", f"data.catalogue={ROOT}/pipeline/physiclear"], ROOT / "conf")
    assert answers_about(cast(Octopi, model), params, fake_videos(["rug"]), {}) == []
    assert re.search(r"octopi-small is not asked: .*(warmth: soft|yielding).*, but .*hardness: soft", caplog.text)


def test_a_copy_whose_heads_alone_answer_is_not_asked(catalogue: Catalogue, caplog: pytest.LogCaptureFixture) -> None:
    """It knows the properties, as heads were fitted to them, but its language model does not."""
    model = SimpleNamespace(catalogue=catalogue, config=SimpleNamespace(speaks=False), name="mine")
    params = compose("smoke", [f"data.catalogue={ROOT}/pipeline/physiclear"], ROOT / "conf")
    assert answers_about(cast(Octopi, model), params, fake_videos(["rug"]), {}) == []
    assert "mine is not asked: its heads alone answer" in caplog.text
