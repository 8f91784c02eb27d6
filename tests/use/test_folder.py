"""The folder of a trained model: whole, without pickles, and noticed where anything in it or below it is another."""

import json
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.core.records import Part
from pipeline.evaluation.grading import grade
from pipeline.scales import write_params
from pipeline.tasks import TASKS
from pipeline.use.folder import CONFIG, FORMAT, OTHER_BASE, Base, ModelConfig, read_folder
from pipeline.use.model import Octopi
from pipeline.use.package import export, package
from pipeline.videos.catalogue import load_catalogue
from tests.checkpoints import contents, cut, edit, write_llama
from tests.conftest import ROOT, octopi, refused
from tests.fake_run import fake_params
from tests.use.shared import PARTS, Made


@pytest.fixture
def copy(made: Made, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made.folder, tmp_path / "copy"))


@pytest.fixture
def llama(made: Made) -> Path:
    return made.folder.parents[1] / "llama"


def test_it_holds_safetensors_and_text_alone_and_a_card(made: Made) -> None:
    assert {Path(name).suffix for name in contents(made.folder)} <= {".json", ".safetensors", ".md"}
    text = (made.folder / "README.md").read_text()
    assert "| test objects | Looked at before. |" in text, "what the report knows of them"
    front = yaml.safe_load(text.split("---\n")[1])
    assert "base_model" not in front, "none of them is on the Hub"
    catalogue = load_catalogue(Path(ROOT / made.params.data.catalogue))
    scores = [s for s in grade(made.questions, made.predictions, catalogue) if s.measure in ("choice", "combined")]
    for result in front["model-index"][0]["results"]:
        (metric,), own = result["metrics"], [s for s in scores if TASKS[s.task].title == result["task"]["name"]]
        assert metric["value"] == pytest.approx(np.mean([s.correct for s in own]), abs=1e-6), "of its own fold"
        assert metric["args"]["low"] <= metric["value"] <= metric["args"]["high"]
        assert metric["args"]["n"] == len(own)
    config, _ = read_folder(made.folder)
    assert next(iter(config.base.files.values())) in text
    assert set(config.objects) == {name for name, part in PARTS.items() if part is not Part.TEST}


def test_equal_inputs_give_equal_folders(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was fitted or summed is rounded, since another processor changes its last bits."""
    told = json.loads((made.folder / "config.json").read_text())
    moved = {name: float(np.nextafter(told[name], 99)) for name in ("quiet", "usual")}
    moved["temperatures"] = {name: float(np.nextafter(t, 99)) for name, t in told["temperatures"].items()}
    assert ModelConfig.model_validate({**told, **moved}) == ModelConfig.model_validate(told)
    monkeypatch.chdir(made.folder.parents[1])
    package(made.params, made.variant, Base.of(Path("llama")), tmp_path / "new")
    assert contents(tmp_path / "new") == contents(made.folder)


def test_the_stage_packages_what_is_asked_for(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(made.folder.parents[1], tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "models")
    (tmp_path / "models" / "octopi-lab-left-1").mkdir(parents=True)
    for trained in (tmp_path / "data" / "models").iterdir():
        shutil.copytree(trained / "finetuned-all-0", trained / "finetuned-none-0")
    monkeypatch.chdir(tmp_path)
    for overrides, made_too in (([], []), (["packaged=all"], ["finetuned-with-none-0"])):
        lists = ["ablation.encoders=[finetuned]", "ablation.lora=[with]", "ablation.opd=[none,all]"]
        own = {name: getattr(made.params, name) for name in ("frames", "encoder", "language")}
        write_params(fake_params(*lists, *overrides).model_copy(update=own))
        runpy.run_path(str(ROOT / "stages" / "package.py"), run_name="__main__")
        assert sorted(f.name for f in (tmp_path / "models").iterdir()) == sorted(
            [made.variant.key, "octopi-lab-left-1", *made_too]
        ), "what somebody put there stays"


def test_export_with_its_base_needs_nothing_else(made: Made, copy: Path, files: list[Path], tmp_path: Path) -> None:
    question = ("Describe {tactile}.", files[:1])
    expected = Octopi.from_pretrained(made.folder).ask(*question)
    with refused(r"language model llama is not there .*--base"):
        Octopi.from_pretrained(copy)
    octopi("export", made.folder, tmp_path / "whole", "--with-base")
    assert Octopi.from_pretrained(tmp_path / "whole").ask(*question) == expected
    with refused("is there already"):
        export(made.folder, tmp_path / "whole")


def test_a_base_by_name_and_one_in_a_known_place(copy: Path, llama: Path, tmp_path: Path) -> None:
    assert Octopi.from_pretrained(copy, base=llama).config.base.folder == "llama"
    other = write_llama(copy / "base", seed=5)
    shutil.copytree(llama, tmp_path / "llama")
    usual = Octopi.from_pretrained(copy, base=llama).doubts
    assert Octopi.from_pretrained(copy).doubts == usual, "another's is passed over where it is not named"
    assert Octopi.from_pretrained(copy, base=other).doubts == (*usual, OTHER_BASE)
    with refused(OTHER_BASE):
        export(copy, tmp_path / "whole", with_base=True, base=other)
    tokenizer = other / "tokenizer.json"
    words = json.loads(tokenizer.read_text())
    tokenizer.write_text(json.dumps(words))
    assert Octopi.from_pretrained(copy, base=other).doubts == (*usual, OTHER_BASE), "the same words in another file"
    own = (tmp_path / "llama").rename(tmp_path / "away")
    with refused(r"base: is another language model .*tokenizer.json differs"):
        Octopi.from_pretrained(copy, base=other)
    own.rename(tmp_path / "llama")
    words["model"]["vocab"] |= {"!": words["model"]["vocab"]['"'], '"': words["model"]["vocab"]["!"]}
    tokenizer.write_text(json.dumps(words))
    with refused(r"base: is another language model .*tokenizer.json differs"):
        Octopi.from_pretrained(copy, base=other)
    other = tmp_path / "llama"
    template = "{% for m in messages %}<{{ m.role }}>{{ m.content }}</s>{% endfor %}"
    template += "{% if add_generation_prompt %}<assistant>{% endif %}"
    (other / "chat_template.jinja").write_text(template)
    with refused("chat format is another"):
        Octopi.from_pretrained(copy, base=other)


READ = ("encoder/encoder.safetensors", "language/connector.safetensors", "catalogue.json")


def other_frames(folder: Path) -> None:
    edit(folder / CONFIG, frames=json.loads((folder / CONFIG).read_text())["frames"] | {"per_video": 4})


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / CONFIG).unlink(), "holds no config.json"),
        (lambda f: (f / CONFIG).write_text("{"), "not JSON"),
        (lambda f: (f / CONFIG).write_text('{"format": 0}'), f"of format 0, .* {FORMAT}"),
        (lambda f: (f / CONFIG).write_text(f'{{"format": {FORMAT}}}'), "Field required"),
        (other_frames, "frame settings are not those of training"),
        (lambda f: (f / "catalogue.json").unlink(), "catalogue.json: is missing"),
        *((lambda f, name=name: cut(f / name), f"{name}: differs") for name in READ),
    ],
)
def test_what_is_no_model_or_a_changed_one_is_refused(
    spoil: Callable[[Path], object], words: str, copy: Path, llama: Path
) -> None:
    spoil(copy)
    with refused(words):
        Octopi.from_pretrained(copy, base=llama)
