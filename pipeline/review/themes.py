"""How a report's tables and figures are grouped on the page, and what a reviewer would look for in vain."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Theme:
    """A group of tables and figures, by file name without ending, in reading order."""

    key: str
    title: str
    names: tuple[str, ...]


THEMES = (
    Theme("results", "The paper's tables", ("understanding", "scenario_reasoning", "property_description")),
    Theme(
        "parts",
        "What each part brings",
        (
            *("directions", "effects", "factorial", "encoder_understanding", "encoder_property"),
            *("lora_understanding", "lora_property", "describing", "reasoning", "ablation", "all_variants"),
        ),
    ),
    Theme("seeds", "Why do runs differ?", ("seeds",)),
    Theme("touch", "Is touch used?", ("touch",)),
    Theme(
        "encoders",
        "Encoders",
        (
            *("cross_validation", "differences", "learning_curve", "errors", "agreement"),
            *("confusion_matrices", "embedding_map"),
        ),
    ),
    Theme("training", "Training curves", ("training_curves",)),
    Theme(
        "data",
        "The data",
        ("property_counts", "property_combinations", "video_lengths", "annotator_agreement", "audit"),
    ),
)
OTHERS = Theme("others", "Further tables", ())
SAMPLES = Theme("samples", "Sample answers", ())
ORIGIN = Theme("origin", "Where it comes from", ())


@dataclass(frozen=True)
class Expected:
    """A table that a report may lack, and why that would be."""

    name: str
    title: str
    reason: str
    wanted: str = ""
    """The list in params.yaml that asks for it; where it names something, `due` is the reason."""
    due: str = "the report is older than this table; `dvc repro` at its scale writes it"


EXPECTED = (
    Expected(
        "directions",
        "Do the paper's directions hold?",
        "no two of its variants differ in a part that the paper leaves out, or it is older than this table",
    ),
    Expected("effects", "What each part brings", "no two of its variants differ in one part alone", "plan.lora"),
    Expected(
        "factorial", "Main effects and interactions", "its plan crosses no two parts, or it is older than this table"
    ),
    Expected("seeds", "Why results differ from run to run", "nothing was answered", "plan.variants"),
    Expected("describing", "Describing what is needed, or everything", "its plan has no variant with OPD `needed`"),
    Expected(
        "reasoning",
        "Touch or reasoning: where answers go wrong",
        "its plan has no variant that describes before it concludes, or it is older than this table",
    ),
    Expected(
        "touch",
        "Is touch used?",
        "`ablation.counterfactuals` names nothing to put in the place of touch",
        "ablation.counterfactuals",
    ),
    Expected(
        "cross_validation",
        "Encoders over all objects",
        "`cross_validation.models` names no model",
        "cross_validation.models",
        "its models have not been cross-validated; `dvc repro compare_encoders` at its scale does it",
    ),
)
NO_SAMPLES = "the report is older than sample answers are; `dvc repro` at its scale writes them"
NO_GATE = "no gate.csv lay beside its language model, or the report is older than the gate"
EVERYWHERE = (
    Expected("speed_error", "Speed against error, all parts in one table", "`octopi page` gathers it"),
    Expected("stability", "Numerical stability", "nothing has written a stability.csv yet"),
)


@dataclass(frozen=True)
class BenchText:
    """What a section of the benchmarks is about."""

    title: str
    caption: str


BENCHES = {
    "coverage": BenchText(
        "Do intervals hold what they promise?",
        "Simulated designs with a known truth: how often an interval holds it, or a test rejects it. An interval that "
        "is called 95 % *holds* where it covers 93 to 97 % as far as the repetitions can tell; *liberal* covers less, "
        "*conservative* more. Where the reports' own intervals fall short comes first; `bench/coverage.md` has every "
        "method.",
    ),
    "encoder": BenchText(
        "Encoders", "Resolution, frames, number formats, prompts and training speed, cost against combined error."
    ),
    "frames": BenchText(
        "Finding frames", "Time of each rule for choosing frames, against bare decoding and the published way."
    ),
    "language": BenchText("Language model", "Training and generation against the published way, in one run."),
    "realism": BenchText(
        "How like real videos scenes are",
        "Distances between synthetic and real videos, against two halves of the real.",
    ),
    "scenes": BenchText(
        "Models of contact", "Time of a contact against the error in what the camera sees, and whether labels hold."
    ),
    "selection": BenchText(
        "Which frames, and how many", "Time of a video against the combined error on objects never touched."
    ),
    "startup": BenchText("Starting", "What stages pay before their first line of work."),
}
