"""The command `octopi`."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import typer
from typer.core import TyperGroup

from pipeline.running.errors import UserError, counted

if TYPE_CHECKING:
    from pipeline.use.model import Octopi
    from pipeline.videos.records import Finding


class Commands(TyperGroup):
    """Ends a command that Ctrl-C stops with one line."""

    def invoke(self, ctx: Any) -> Any:
        """Typer alone would say nothing of Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("octopi: stopped; what is finished stays, call it again to go on", err=True)
            raise typer.Exit(130) from None


app = typer.Typer(cls=Commands, no_args_is_help=True, pretty_exceptions_enable=False)
data_app = typer.Typer(help="Look at a folder of tactile videos.", no_args_is_help=True)
app.add_typer(data_app, name="data")
import_app = typer.Typer(help="Make videos of other recordings.", no_args_is_help=True)
app.add_typer(import_app, name="import")
questions_app = typer.Typer(help="Let any other model answer the run's questions.", no_args_is_help=True)
app.add_typer(questions_app, name="questions")


task_app = typer.Typer(help="Write a task of your own.", no_args_is_help=True)
app.add_typer(task_app, name="task")


@app.callback(invoke_without_command=True)
def octopi(version: Annotated[bool, typer.Option("--version", help="Say the version, and no more.")] = False) -> None:
    """Teach a language model the sense of touch."""
    if version:
        typer.echo(f"octopi-pipeline {metadata.version('octopi-pipeline')}")
        raise typer.Exit


@app.command()
def scale(
    name: Annotated[
        str,
        typer.Argument(
            help="smoke, small, invented, evaluate, paper-7b, paper-13b or rehearsal (or your file in conf/)."
        ),
    ],
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value, for example split.name=kfold.")] = None,
    plan: Annotated[bool, typer.Option("--plan", help="Say what it would take, and write nothing.")] = False,
) -> None:
    """Choose what `dvc repro` runs: write params.yaml from conf/NAME.yaml and the overrides."""
    from pipeline.config.params import in_project
    from pipeline.running.stage import running_stages
    from pipeline.scales import check_inputs, compose, prune, write_params
    from pipeline.scales.cost import card, costs
    from pipeline.scales.memory import count, read_shapes, table

    in_project()
    if not plan and (running := running_stages()):
        raise UserError(f"{running[0]} is running, and would be recorded with other parameters; wait for it or stop it")
    params = compose(name, overrides or ())
    shapes = read_shapes(params)
    # First, since what a scale takes is asked before its weights are fetched.
    if uses := [*count(params, shapes)]:
        typer.echo(f"Memory in GiB on each device, counted from shapes:\n{table(uses)}")
        if params.runtime.device == "cuda":
            typer.echo(card(params, uses))
    typer.echo("\n".join([*shapes.notes, *costs(params, shapes)]))
    if plan:
        typer.echo(f"{len(params.ablation.variants())} variants; nothing is written.")
        return
    if lacking := check_inputs(params):
        typer.echo(lacking)
    changed = write_params(params)
    prune(params, Path())
    typer.echo(
        f"params.yaml {'written' if changed else 'unchanged'}: {name}, {len(params.ablation.variants())} variants"
    )
    typer.echo(f"`dvc repro` runs it; its tables go to reports/{params.report_name}/")


@app.command()
def weights(
    name: Annotated[
        str,
        typer.Argument(
            help="vicuna-7b, vicuna-13b, clip-vit-large or sparsh of SOURCE; smollm2, efficientnet-lite0 or one with "
            "random weights (tiny-clip, tiny-llama, random-clip-vit-large, random-vicuna-7b), which are made here; or "
            "octopi-7b, octopi-13b, the weights of Octopi's authors. The README of github.com/clear-nus/octopi links "
            "them, and states no licence; wanted are encoder.pt, project.pt, tokenizer/, llm_weights/ and, where it is "
            "there, classifier.pt."
        ),
    ],
    source: Annotated[Path | None, typer.Argument(help="Folder that it was downloaded to.")] = None,
    to: Annotated[Path | None, typer.Option(help="Folder; below weights/ or models/ by default.")] = None,
    base: Annotated[Path | None, typer.Option(help="octopi-7b, octopi-13b: Vicuna's folder.")] = None,
    clip: Annotated[Path | None, typer.Option(help="octopi-7b, octopi-13b: CLIP ViT-L/14's folder.")] = None,
    trust_pickle: Annotated[
        bool, typer.Option("--trust-pickle", help="Read tensors from pickles; no code of them is run.")
    ] = False,
) -> None:
    """Make a base model as a folder of safetensors, or convert or check a downloaded one."""
    from pipeline.running.progress import quiet_libraries
    from pipeline.use.published import CHECKPOINTS, convert
    from pipeline.weights import DOWNLOADED, MADE
    from pipeline.weights.make import make
    from pipeline.weights.published import SUMS, adopt, new_folder

    quiet_libraries()
    if name in CHECKPOINTS:
        if source is None or base is None or clip is None:
            raise UserError(f"{name}: name its folder, --base (Vicuna's folder) and --clip (CLIP ViT-L/14's)")
        folder, unused = convert(name, source, base, clip, to, trust_pickle=trust_pickle)
        left = f"unused: {', '.join(unused)}" if unused else "every tensor is used"
        typer.echo(f"{folder}: written, {left}; `octopi ask --model {folder}` asks it")
        return
    if name not in DOWNLOADED:
        if source is not None and name in MADE:
            raise UserError(f"{name} is not downloaded but made; leave {source} out, and name a folder with --to")
        folder, done = new_folder(to or Path("weights") / name), "made"
        make(name, folder)
    elif source is None:
        repository = DOWNLOADED[name].repository
        raise UserError(f"{name}: name the folder that `hf download {repository} --local-dir FOLDER` put it in")
    else:
        folder = adopt(name, source, to, trust_pickle=trust_pickle)
        done = f"{'checked' if folder == source else 'written'}, with {SUMS}"
    typer.echo(f"{folder}: {done}; name it as encoder.weights or language.weights of `octopi scale`")


@app.command()
def page() -> None:
    """Write reports/index.html, one page over all reports that opens from disk."""
    from pipeline.config.params import in_project
    from pipeline.report.page import write_page

    in_project()
    file = write_page(Path())
    typer.echo(f"{file}: {file.stat().st_size / 1000:.0f} kB")


@app.command()
def publish() -> None:
    """Show what lies in data/ and reports/ in MLflow, as `dvc repro` does at its end; a second call adds nothing."""
    from pipeline.config.params import load_params
    from pipeline.tracking.publish import publish as to_mlflow

    typer.echo(to_mlflow(load_params()))


Catalogue = Annotated[Path, typer.Option(help="Folder with objects.csv and properties.yaml.")]
Times = Annotated[float, typer.Option(min=1.0, help="A press begins at this many times the quiet level.")]
Out = Annotated[Path, typer.Option(help="Folder of the videos.")]
PHYSICLEAR = Path(__file__).parents[1] / "physiclear"


@data_app.command()
def check(
    folder: Annotated[Path, typer.Argument(help="Folder with the videos.")],
    catalogue: Annotated[Path | None, typer.Option(help="By default FOLDER/catalogue, or else PhysiCLeAR's.")] = None,
) -> None:
    """List every file of a folder, or of its videos/ beside catalogue/, that is wrong or odd; status 1 for an error."""
    from pipeline.videos.audit.run import check_folder
    from pipeline.videos.catalogue import load_catalogue

    own, videos = folder / "catalogue", folder / "videos"
    catalogue = catalogue or (own if own.is_dir() else PHYSICLEAR)
    folder = videos if own.is_dir() and videos.is_dir() else folder
    _print_findings(check_folder(folder, load_catalogue(catalogue)))


@data_app.command()
def audit(
    folder: Annotated[Path, typer.Argument(help="Folder with the videos.")],
    catalogue: Catalogue = PHYSICLEAR,
    split: Annotated[str, typer.Option(help="Also look for leaks between the parts of this split.")] = "",
    out: Annotated[Path, typer.Option(help="Where all findings go.")] = Path("audit.csv"),
) -> None:
    """Measure what can be trusted: files, contact, labels, copies, sessions, leaks; status 1 where errors are found."""
    from pipeline.config import SplitConfig
    from pipeline.core.io import write_csv
    from pipeline.videos.audit.run import audit_folder
    from pipeline.videos.catalogue import load_catalogue
    from pipeline.videos.records import Finding

    # Not validated: a name that no split can have is a finding, like one that this catalogue's splits do not.
    config = SplitConfig.model_construct(name=split) if split else None
    findings = audit_folder(folder, load_catalogue(catalogue), config)
    write_csv(out, Finding, findings)
    typer.echo(f"{len(findings)} findings in {out}")
    _print_findings(findings)


@task_app.command("check")
def check_task(
    name: Annotated[str, typer.Argument(help="Its name, such as pc.")], catalogue: Catalogue = PHYSICLEAR
) -> None:
    """Build questions of a task, and grade right and wrong answers to them; status 1 where one is not as it should."""
    from pipeline.cli.task import check
    from pipeline.videos.catalogue import load_catalogue

    typer.echo(check(name, load_catalogue(catalogue).asking("published")))


@import_app.command()
def bag(
    file: Annotated[Path, typer.Argument(help="ROS 1 .bag, ROS 2 folder, .mcap or .db3.")],
    topic: Annotated[str, typer.Option(help="Of sensor_msgs/Image or CompressedImage.")],
    out: Out,
    object_id: Annotated[str, typer.Option("--object", help="What is touched; the recording's name by default.")] = "",
    times: Times = 2.0,
) -> None:
    """Cut a robot's recording into presses: videos for the chain and `octopi ask`, each with its times in a CSV."""
    from pipeline.videos.files import extending
    from pipeline.videos.importing.bags import shots
    from pipeline.videos.importing.presses import cut_into

    with extending(out):
        written = cut_into(lambda: shots(file, topic), f"{file}, {topic}", out, object_id or file.stem, times)
    typer.echo(f"{len(written)} presses in {out}: {', '.join(path.name for path in written)}")


@import_app.command()
def video(
    file: Annotated[
        Path, typer.Argument(help="A video with several presses, a folder of PNG or JPEG pictures, or a table.")
    ],
    out: Out,
    object_id: Annotated[str, typer.Option("--object", help="What is touched; the file's name by default.")] = "",
    times: Times = 2.0,
    fps: Annotated[float, typer.Option(min=0, help="Pictures a second, where the file does not say.")] = 0.0,
    whole: Annotated[bool, typer.Option("--whole", help="Write one video of all of it.")] = False,
) -> None:
    """Cut a long recording into presses: videos for the chain and `octopi ask`, each with its times in a CSV.

    A table (file, object_id, begin and end in seconds, session) says itself where to cut: one video a line.
    """
    from pipeline.videos.files import extending
    from pipeline.videos.importing.presses import cut_into, cut_listed, film

    with extending(out):
        if file.suffix.lower() == ".csv":
            written = cut_listed(file, out, fps)
        else:
            written = cut_into(lambda: film(file, fps), str(file), out, object_id or file.stem, times, whole=whole)
    typer.echo(f"{counted(len(written), 'video')} in {out}: {', '.join(path.name for path in written)}")


@import_app.command()
def lerobot(
    dataset: Annotated[Path, typer.Argument(help="Folder of a LeRobot dataset, v3.0 or v2.1.")],
    video: Annotated[str, typer.Option(help="Key of its tactile camera, such as observation.images.gelsight.")],
    out: Out,
    objects: Annotated[
        Path | None, typer.Option(help="CSV of object_id and episode, or task; by default an object is called by it.")
    ] = None,
    pressed: Annotated[bool, typer.Option("--presses", help="Write each press as a video.")] = False,
    times: Times = 4.0,
) -> None:
    """Make a video of each episode, where possible without encoding it anew, and a `videos.csv`."""
    from pipeline.videos.files import extending
    from pipeline.videos.importing.lerobot import import_episodes

    with extending(out):
        written = import_episodes(dataset, video, out, objects, times, pressed=pressed)
    typer.echo(f"{counted(len(written), 'new video')} in {out}: {', '.join(path.name for path in written)}")


def _print_findings(findings: Sequence[Finding]) -> None:
    """Print an audit's findings; errors among them end the command with status 1."""
    for f in findings:
        expected = f" (expected: {f.expected})" if f.expected else ""
        if f.check == "contact" and f.severity == "warning":
            expected += "; press harder, and let the recording begin before the press"
        typer.echo(f"{f.severity:8} {f.check}: {f.item}: {f.measured}{expected}")
    if any(f.severity == "error" for f in findings):
        raise typer.Exit(1)


@app.command("answer-with")
def answer_with(
    endpoint: Annotated[str, typer.Option(help="URL that OpenAI's client takes, such as https://api.openai.com/v1.")],
    model: Annotated[str, typer.Option(help="Its name there.")],
    shown: Annotated[
        Literal["frames", "photos"], typer.Option("--input", help="What it sees in place of each tactile video.")
    ],
    folder: Annotated[
        Path | None, typer.Argument(metavar="[DIR]", help="Of the photos, or of kept frames (data/frames).")
    ] = None,
    temperature: Annotated[float, typer.Option(min=0, help="1 for models that take no other.")] = 0.0,
    max_tokens: Annotated[int, typer.Option(min=1, help="Of a reply.")] = 1024,
) -> None:
    """Let a model behind an endpoint answer the evaluation questions about pictures; OPENAI_API_KEY holds its key."""
    from pipeline.config.params import load_params
    from pipeline.evaluation.answer_with import ask_all
    from pipeline.evaluation.records import Shown

    if folder is None and shown == "photos":
        raise UserError("DIR: name the folder with photos, as in `--input photos DIR`")
    settings = {"model": model, "temperature": temperature, "max_completion_tokens": max_tokens}
    place = folder or Path("data/frames")
    typer.echo(ask_all(load_params(), endpoint.rstrip("/"), settings, Shown(shown), place))


@questions_app.command("export")
def export_questions(file: Annotated[Path, typer.Argument(help="JSON lines: id, task, turns, videos.")]) -> None:
    """Write the evaluation questions for a model of your own; file names name objects, so do not show them to it."""
    from pipeline.config.params import load_params
    from pipeline.evaluation.outside import export

    typer.echo(export(load_params(), file))


@questions_app.command("grade")
def grade_answers(
    file: Annotated[Path, typer.Argument(help="JSON lines: id, and text (a list of texts for several turns).")],
    name: Annotated[str, typer.Option(help="What tables call the model.")],
) -> None:
    """Put a model's answers beside the others in the report, which `dvc repro` writes."""
    from pipeline.config.params import load_params
    from pipeline.evaluation.outside import take

    typer.echo(take(load_params(), file, name))


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def repro(context: typer.Context) -> None:
    """Run `dvc repro`, and say before it how many stages will run."""
    from pipeline.cli.reproduce import reproduce

    raise typer.Exit(reproduce(Path(), context.args))


@app.command()
def diff(
    old: Annotated[str, typer.Argument(help="A Git revision (a hash, a tag, HEAD~1) or an experiment's name.")],
    new: Annotated[str, typer.Argument(help="Another one; without it, what lies on disk now.")] = "",
    json: Annotated[Path | None, typer.Option(help="Also write everything to this file, for machines.")] = None,
) -> None:
    """Say what differs between two revisions: parameters, metrics, and whether answers really got better."""
    from pipeline.cli.diff import compare, describe
    from pipeline.config.params import in_project
    from pipeline.core.io import write_json

    in_project()
    found = compare(Path(), old, new)
    if json is not None:
        write_json(json, found)
    typer.echo(describe(found))


Video = Annotated[str, typer.Argument(help="A video.")]
Another = Annotated[str, typer.Argument(help="Another one.")]
Property = Annotated[str, typer.Argument(help="Such as hardness, or softer.")]
Model = Annotated[str | None, typer.Option(help="Folder or hf://USER/NAME\\[@REVISION]; else the shipped one.")]
Base = Annotated[
    Path | None, typer.Option(help="Folder of its language model, where no known place has it, or of one like it.")
]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or mps.")]
Folder = Annotated[str | None, typer.Argument(help="Folder or hf://USER/NAME\\[@REVISION]; else the shipped one.")]
Memory = Annotated[Path, typer.Option(help="Folder of remembered touches.")]
TOUCHES = Path("touches")


@app.command()
def ask(
    question: Annotated[
        str, typer.Argument(help="Videos stand in front, or where it says {tactile}; without a question: a chat.")
    ] = "",
    videos: Annotated[list[str] | None, typer.Argument(help="Videos, in the order of the question.")] = None,
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
    json: Annotated[bool, typer.Option("--json", help="Print the answer with what it stands on.")] = False,
    memory: Annotated[
        Path | None, typer.Option(help="Folder of remembered touches: what each video is most like is told with it.")
    ] = None,
) -> None:
    """Ask a trained model about touch; without a question, talk to it (/add FILE, /frames, /reset, /quit)."""
    from json import dumps
    from os.path import isfile

    from pipeline.use.ask import Chat, answer_once, lines_of_terminal

    if isfile(question):  # pathlib's raises where a question is longer than a file's name may be.
        raise UserError(f"{question}: is a file; write the question before it")
    if not question and (json or memory):
        raise UserError(f"--{'json' if json else 'memory'} takes a question")
    asked = _load(model, base, device)
    if memory:
        question = asked.reminded(question, videos or (), memory)

    if not question:
        Chat(asked, partial(typer.echo, nl=False)).run(lines_of_terminal())
    elif json:
        typer.echo(dumps(answer_once(asked, question, videos or ()), ensure_ascii=False))
    else:
        said = ""
        for piece in asked.stream(question, videos or ()):
            typer.echo(piece, nl=False)
            said += piece
        typer.echo()
        heads = asked.verdict(question, videos or ())
        _print_notes((*asked.apart(said, heads), *asked.notes(videos or (), question)), heads.shown if heads else "")


@app.command()
def describe(
    videos: Annotated[list[Path], typer.Argument(help="Videos, or folders with videos.")],
    csv: Annotated[
        Path | None, typer.Option(help="Write a row each to this file; a second call goes on in it.")
    ] = None,
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
) -> None:
    """Describe videos, and every video of folders: classes with probabilities, the model's sentence, notes."""
    from pipeline.use.ask import describe_folder, described

    asked = _load(model, base, device)
    if csv is None:
        from rich.console import Console

        table, notes = described(asked, videos)
        Console().print(table)
        _print_notes(notes)
        return
    rows, failed = describe_folder(asked, videos, csv)
    lacking = f", {failed} of them not described (column error; delete their rows to try them again)" if failed else ""
    typer.echo(f"{csv}: {counted(rows, 'video')}{lacking}")
    _print_notes(asked.doubts)
    if failed == rows:
        raise typer.Exit(1)


@app.command()
def compare(
    a: Video, b: Another, property: Property, model: Model = None, base: Base = None, device: Device = "auto"
) -> None:
    """Say whether the first video has more of a property than the second."""
    found = _load(model, base, device, property).compare(a, b, property)
    typer.echo(found.answer)
    _print_notes(found.notes, found.heads)


@app.command()
def rank(
    property: Property,
    paths: Annotated[list[Path], typer.Argument(metavar="VIDEOS...", help="Two videos or more, or folders of them.")],
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
) -> None:
    """Order videos by a property, least first, each with its expected class, and ask the model about two or three."""
    from pipeline.use.ask import videos_of

    videos = [file for file, _ in videos_of(paths)]
    asked = _load(model, base, device, property)
    found = asked.rank(videos, property)
    classes = ", ".join(f"{number} {level}" for number, level in enumerate(found.levels))
    typer.echo(f"{found.property} by the {asked.config.judge}: {classes}")
    for place in found.order:
        typer.echo(f"{found.expected[place]:.2f}  {videos[place]}")
    if found.answer:
        typer.echo(found.answer)
    _print_notes(found.notes)


@app.command()
def match(
    videos: Annotated[list[str], typer.Argument(help="Two or three videos.")],
    names: Annotated[
        str,
        typer.Option(
            help="As many objects: 'a mug: hard, smooth, no bumps; a rug: soft, rough, no bumps', "
            "or names or ids of the model's catalogue, with commas."
        ),
    ],
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
) -> None:
    """Say which video is of which object: by the property heads, and in the model's own words."""
    from pipeline.use.ask import named_objects

    asked = _load(model, base, device)
    found = asked.match(videos, named_objects(names))
    for video, name in zip(videos, found.heads, strict=True):
        typer.echo(f"{video}: {name} (by the {asked.config.judge})")
    if found.answer:
        typer.echo(found.answer)
    _print_notes(found.notes)


@app.command()
def remember(
    name: Annotated[str, typer.Argument(help="What the object is called, such as 'my mug'.")],
    videos: Annotated[list[str], typer.Argument(help="Videos of it being touched; one is enough.")],
    memory: Memory = TOUCHES,
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
) -> None:
    """Keep touches of an object, by which it is recognised later, without training."""
    loaded = _load(model, base, device)
    for video in videos:
        known = loaded.remember(name, video, memory)
        _print_notes(loaded.notes(video))
    typer.echo(f"{memory}: remembers {counted(known, 'video')}")


@app.command()
def recognise(
    video: Video, memory: Memory = TOUCHES, model: Model = None, base: Base = None, device: Device = "auto"
) -> None:
    """Say which remembered objects a touch is like, the most similar first."""
    found = _load(model, base, device).recognise(video, memory)
    for known in found.objects[:5]:
        typer.echo(f"{known.similarity:.3f}  {known.name} ({', '.join(known.classes)})")
    _print_notes(found.notes)


@app.command()
def adapt(
    videos: Annotated[list[Path], typer.Argument(help="Videos of another sensor, or folders of them.")],
    out: Annotated[Path, typer.Option(help="Folder of the copy, which --model names.")],
    catalogue: Annotated[
        Path | None, typer.Option(help="Ratings of the videos' objects (docs/data.md): heads are read anew from them.")
    ] = None,
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
) -> None:
    """Fit a model to another sensor by videos alone, or to your own objects and properties by a few ratings."""
    from pipeline.use.adapt import adapt as fit
    from pipeline.use.adapt import rated_videos
    from pipeline.use.ask import videos_of
    from pipeline.videos.catalogue import load_catalogue

    ratings = None if catalogue is None else load_catalogue(catalogue)
    found = {file: "" for file, _ in videos_of(videos)} if ratings is None else rated_videos(videos, ratings)
    told = fit(_load(model, base, device), [*found], out, catalogue=ratings, objects=[*filter(None, found.values())])
    typer.echo(f"{told}\n{out}: written; name it with --model {out}")


@app.command()
def live(
    camera: Annotated[str, typer.Argument(help="A camera's index (0 is the first) or address, or a video.")],
    question: Annotated[str, typer.Option("--ask", help="Asked of each press, in place of a description.")] = "",
    times: Times = 2.0,
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
) -> None:
    """Watch a camera, and say of each press what is felt when it ends, with the true frame rate; Ctrl-C ends it."""
    from pipeline.use.live import run

    asked = _load(model, base, device)
    typer.echo(f"{camera}: leave the sensor untouched for a second, then press it", err=True)
    if not run(asked, camera, question, typer.echo, times):
        typer.echo(f"{camera}: no press found; lower --times", err=True)


@app.command()
def export(
    folder: Annotated[Path, typer.Argument(help="Folder of a trained model, such as models/finetuned-with-all-0.")],
    to: Annotated[Path, typer.Argument(help="Folder to make.")],
    with_base: Annotated[bool, typer.Option("--with-base", help="Put the language model in.")] = False,
    base: Base = None,
) -> None:
    """Copy a trained model to where it is to be used."""
    from pipeline.use.package import export as copy

    copy(folder, to, with_base=with_base, base=base)
    typer.echo(f"{to}: {sum(f.stat().st_size for f in to.rglob('*') if f.is_file()) / 1e6:.0f} MB")


@app.command()
def push(
    folder: Annotated[Path, typer.Argument(help="Folder of a trained model, such as models/finetuned-with-all-0.")],
    name: Annotated[str, typer.Argument(metavar="USER/NAME", help="Repository; made where it is not there.")],
    private: Annotated[bool, typer.Option("--private", help="Make it a private one.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the files and the card, and send nothing.")] = False,
) -> None:
    """Put a trained model on the Hugging Face Hub, in place of what lies there; `--model hf://USER/NAME` gets it."""
    from pipeline.training.card import CARD_FILE
    from pipeline.use.hub import HUB, files_of, upload

    if dry_run:
        typer.echo("\n".join([*files_of(folder), "", (folder / CARD_FILE).read_text(encoding="utf-8")]))
        return
    upload(folder, name, private=private)
    typer.echo(f"{HUB}{name}: written; name it so with --model")


@app.command()
def serve(
    folder: Folder = None,
    host: Annotated[str, typer.Option(help="Address; another than 127.0.0.1 needs a token.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="0 for any that is free.")] = 8000,
    token_file: Annotated[Path | None, typer.Option(help="File with the token; else OCTOPI_TOKEN is taken.")] = None,
    base: Base = None,
    device: Device = "auto",
    places: Annotated[int, typer.Option(min=1, help="Requests at once; the next is told to come later.")] = 32,
) -> None:
    """Answer questions about touches over HTTP, in the form of OpenAI's chat completions."""
    from pipeline.core.layout import SHIPPED
    from pipeline.use.serve import serve

    serve(lambda: _load(folder, base, device), Path(folder or SHIPPED).resolve().name, host, port, token_file, places)


@app.command()
def demo(
    folder: Folder = None,
    base: Base = None,
    device: Device = "auto",
    catalogue: Catalogue = PHYSICLEAR,
    port: Annotated[int, typer.Option(help="Of 127.0.0.1.")] = 7860,
) -> None:
    """Show a page to drop videos on: what the model sees, what it takes them for, and a chat. Nothing leaves."""
    from pipeline.use.demo import serve_demo

    serve_demo(lambda: _load(folder, base, device), catalogue, port)


@app.command()
def studio(
    folder: Annotated[Path, typer.Argument(help="Folder of videos and ratings; made where it is not there.")],
    camera: Annotated[str, typer.Option(help="A camera's index (0 is the first) or address, or a video.")] = "0",
    times: Times = 2.0,
    model: Model = None,
    base: Base = None,
    device: Device = "auto",
    port: Annotated[int, typer.Option(help="Of 127.0.0.1.")] = 7860,
) -> None:
    """Show a page for a sensor on the desk: record presses, rate them, adapt the model, ask it. Nothing leaves."""
    from pipeline.use.studio import Studio, serve_studio
    from pipeline.videos.files import extending

    def load(copy: str | None) -> Octopi:
        return _load(copy or model, base, device)

    with extending(folder / "videos"):
        serve_studio(lambda: Studio(load, folder, camera, times, newest=model is None), port)


def _print_notes(notes: Sequence[str], heads: str = "") -> None:
    """Print on the error stream what the property heads say, and what speaks against an answer, each note once."""
    if heads:
        typer.echo(f"property heads: {heads}", err=True)
    for note in dict.fromkeys(notes):
        typer.echo(f"note: {note}", err=True)


def _load(folder: str | None, base: Path | None, device: str, property: str = "") -> Octopi:
    """Load a model; a device or a property that it does not know is refused before that takes its time."""
    from pipeline.core.runtime import DeviceName
    from pipeline.running.progress import quiet_libraries

    if device not in get_args(DeviceName):
        raise UserError(f"--device is {device}; allowed: {', '.join(get_args(DeviceName))}")
    if property and not (folder or "").startswith("hf://"):
        from pipeline.core.layout import SHIPPED
        from pipeline.use.folder import find_property, read_folder

        find_property(read_folder(Path(folder or SHIPPED))[1], property)
    quiet_libraries()
    from pipeline.use.model import Octopi

    return Octopi.from_pretrained(folder, base=base, device=cast(DeviceName, device))


def main() -> None:
    """Run the command; bad input ends it with one line and status 1."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A path may hold bytes that are no UTF-8.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        app()
    except Exception as error:
        from pipeline.running.stage import one_line

        if (line := one_line(error)) is None:
            raise
        typer.echo(f"octopi: {line}", err=True)
        raise SystemExit(1) from None
