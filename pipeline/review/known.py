"""How the tables of a report are shown. What a view does not name is shown as it is, so that no column gets lost.

Those about the language model have a module of their own.

Shares have four digits in their files, so percent have two here: with one, a figure that was rounded before could end
up another one than the report's own.
"""

from __future__ import annotations

from pipeline.review.known_language import LANGUAGE
from pipeline.review.views import Bar, Column, Kind, View

HEAD, MEASURED, PRINTED, WORDS = Kind.HEAD, Kind.MEASURED, Kind.PUBLISHED, Kind.WORDS

ACCURACY = View(
    (
        Column("Task", "{row}", HEAD),
        Column("System", "{system}", HEAD),
        Column(
            "Measured %|95 % over objects",
            "{value:.2f}",
            MEASURED,
            "{clustered_low:.1f} to {clustered_high:.1f}",
            otherwise="{note}",
        ),
        Column("k/n|95 % Wilson", "{k:g}/{n}", small="{low:.1f} to {high:.1f}"),
        Column("95 % by resampling objects (optimistic)", "{resampled_low:.1f} to {resampled_high:.1f}"),
        *(
            Column(
                f"Published\N{NO-BREAK SPACE}{model}|n; 95 % Wilson",
                f"{{published_{model}:.2f}}",
                PRINTED,
                f"{{published_{model}_n}}; {{published_{model}_low:.1f}} to {{published_{model}_high:.1f}}",
            )
            for model in ("7b", "13b")
        ),
        Column("Chance %|majority %", "{chance:.2f}", small="{majority:.2f}"),
        Column("Unparsed %|truncated %", "{unparsed:.1f}", small="{truncated:.1f}"),
        Column("Seeds", "{seeds}"),
        Column("Mean ± deviation over seeds", "{seed_mean:.2f} ± {seed_sd:.2f}"),
        Column("By seed", "{seed_values}", WORDS, needs="seed_sd"),
        Column("Note", "{note}", WORDS, needs="value"),
    ),
    Bar(
        "value",
        "clustered_low",
        "clustered_high",
        100,
        chance="chance",
        marks=("published_7b", "published_13b"),
    ),
)
SHARES = (Column("Accuracy %|95 % over objects", "{accuracy:p.2f}", MEASURED, "{low:p.2f} to {high:p.2f}"),)
SHARE_BAR = Bar("accuracy", "low", "high", 1)
ENCODERS = View(
    (
        Column("Model", "{model}", HEAD),
        Column("Property", "{property}", HEAD),
        *SHARES,
        Column("n", "{n}"),
        Column("ms a video", "{ms_per_video:.1f}"),
    ),
    SHARE_BAR,
)
AGREEMENT = View(
    (
        Column("Model", "{model}", HEAD),
        Column("Ratings", "{ratings}", HEAD),
        *SHARES,
        Column("Videos", "{videos}"),
        Column("Objects", "{objects}"),
    ),
    SHARE_BAR,
)
CURVE = View(
    (Column("Model", "{model}", HEAD), Column("Training objects", "{objects:.0f}", HEAD), *SHARES),
    SHARE_BAR,
)
DIFFERENCES = View(
    (
        Column("Model", "{model}", HEAD),
        Column("Against", "{against}", HEAD),
        Column("Difference, points|95 % over objects", "{difference:p+.2f}", MEASURED, "{low:p.2f} to {high:p.2f}"),
        Column("What it is", "{what}", WORDS),
    ),
    Bar("difference", "low", "high", 1, signed=True),
)
ERRORS = View(
    (
        Column("Model", "{model}", HEAD),
        Column("Property", "{property}", HEAD),
        Column("Mean absolute error", "{absolute_error:.3f}", MEASURED),
        Column("Kappa", "{kappa:.3f}", MEASURED),
        Column("Best constant %", "{majority:p.2f}"),
        Column("Chance %", "{chance:p.2f}"),
        Column("Repeats", "{repeats}"),
        Column("Deviation over repeats, points", "{spread:p.2f}"),
    )
)
COUNTS = View(
    (
        Column("Property", "{property}", HEAD),
        Column("Class", "{level}", HEAD),
        Column("Objects", "{objects}", MEASURED),
        Column("%", "{percent:.2f}", MEASURED),
        Column("With videos", "{with_videos}"),
        Column("Train", "{train}"),
        Column("Validation", "{validation}"),
        Column("Test", "{test}"),
        Column("Published", "{published:.0f}", PRINTED),
        Column("Published %", "{published_percent:.2f}", PRINTED),
    )
)
COMBINATIONS = View(
    (
        Column("Combination", "{combination}", HEAD),
        Column("Objects", "{objects}", MEASURED),
        Column("With videos", "{with_videos}"),
        Column("Published", "{published:.0f}", PRINTED),
    )
)


def _figures(digits: int) -> View:
    return View(
        (
            Column("What", "{row}", HEAD),
            Column("Measured", f"{{value:.{digits}f}}", MEASURED),
            Column("Unit", "{unit}", WORDS),
            Column("n", "{n}"),
            Column("Published|n", f"{{published:.{digits}f}}", PRINTED, "{published_n}"),
            Column("Note", "{note}", WORDS),
        )
    )


AUDIT = View(
    (
        Column("Severity", "{severity}", HEAD),
        Column("Check", "{check}", HEAD),
        Column("Item", "{item}", WORDS),
        Column("Measured", "{measured}", Kind.WORDS),
        Column("Expected", "{expected}", WORDS),
    )
)
BENCH = View(
    (
        Column("Case", "{case}", HEAD),
        Column("Cost", "{cost}", MEASURED, "{unit}"),
        Column("Ratio", "{ratio}"),
        Column("to", "{baseline}", WORDS),
        Column("Error", "{error}", MEASURED),
        Column("Interval", "{low} to {high}"),
    )
)
COVERAGE = View(
    (
        Column("Figure", "{kind}", HEAD),
        Column("Method", "{method}", HEAD),
        Column("Objects", "{objects}"),
        Column("Objects a question", "{about}"),
        Column("Correlation", "{correlation:g}"),
        Column("Seeds", "{seeds}"),
        Column("Truth", "{truths}", Kind.LIST),
        Column("Share covered or rejected", "{shares}", Kind.LIST),
        Column("Verdict", "{verdict}", Kind.LIST),
        Column("Mean width", "{cost:.3f}"),
    ),
    hidden=("case", "unit", "baseline", "ratio", "error", "low", "high", "reported", "repetitions"),
)
STABILITY = View(
    (
        Column("Part", "{part}", HEAD),
        Column("Case", "{case}", HEAD),
        Column("Format", "{dtype}", WORDS),
        Column("Finite", "{finite}", WORDS),
        Column("Error", "{error}", MEASURED),
        Column("Bound", "{bound}"),
        Column("Verdict", "{verdict}", WORDS),
    )
)
VIEWS = LANGUAGE | {
    "agreement": AGREEMENT,
    "annotator_agreement": _figures(3),
    "audit": AUDIT,
    "coverage": COVERAGE,
    "cross_validation": ENCODERS,
    "differences": DIFFERENCES,
    "errors": ERRORS,
    "learning_curve": CURVE,
    "property_combinations": COMBINATIONS,
    "property_counts": COUNTS,
    "stability": STABILITY,
    "video_lengths": _figures(1),
}
ACCURACIES = (
    *("understanding", "scenario_reasoning", "property_description", "all_variants"),
    *("encoder_property", "encoder_understanding", "lora_property", "lora_understanding"),
)


def view_of(name: str) -> View:
    """The view of a table by its file's name; of an unknown one all columns, as they are."""
    return ACCURACY if name in ACCURACIES else VIEWS.get(name, View(()))
