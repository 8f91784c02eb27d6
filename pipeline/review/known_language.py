"""How the tables about the language model are shown."""

from __future__ import annotations

from pipeline.review.views import Bar, Column, Kind, View

HEAD, MEASURED, WORDS = Kind.HEAD, Kind.MEASURED, Kind.WORDS

DIFFERENCE = Column("Difference, points|95 %", "{difference:p+.2f}", MEASURED, "{low:p.2f} to {high:p.2f}")
ABLATION = View(
    (
        Column("Encoder", "{encoder}", HEAD),
        Column("LoRA", "{lora}", HEAD),
        Column("OPD", "{opd}", HEAD),
        Column("Seed", "{seed}", HEAD),
        Column("Task", "{task}", HEAD),
        Column("Accuracy %|95 % over objects", "{accuracy:p.2f}", MEASURED, "{low:p.2f} to {high:p.2f}"),
        Column("n", "{n}"),
        Column("Chance %", "{chance:p.2f}"),
        Column("Unparsed %|truncated %", "{unparsed:p.2f}", small="{truncated:p.2f}"),
        Column("Tokens", "{tokens:.0f}"),
        Column("Base model", "{gate}", WORDS),
    ),
    Bar("accuracy", "low", "high", 1, chance="chance"),
    hidden=("source",),
)
DIRECTIONS = View(
    (
        Column("Part", "{part}", HEAD),
        Column("Change", "{change}", HEAD),
        Column("Task", "{task}", HEAD),
        Column("Verdict", "{verdict}", WORDS),
        DIFFERENCE,
        *(Column(f"Published\N{NO-BREAK SPACE}{m}", f"{{published_{m}:p+.2f}}", Kind.PUBLISHED) for m in ("7b", "13b")),
        Column("Base model", "{gate}", WORDS),
    ),
    Bar("difference", "low", "high", 1, signed=True, marks=("published_7b", "published_13b")),
)
EFFECTS = View(
    (
        Column("Part", "{axis}", HEAD),
        Column("Change", "{change}", HEAD),
        Column("Task", "{task}", HEAD),
        DIFFERENCE,
        Column("p|Holm", "{p:.3f}", small="{p_holm:.3f}"),
        Column("p (McNemar)", "{p_mcnemar:.3f}"),
        Column("Smallest effect, points", "{smallest_effect:p.1f}"),
        Column("Deviation of objects, points|of their questions", "{sd_objects:p.1f}", small="{sd_questions:p.1f}"),
        Column("n", "{n}"),
        Column("Pairs", "{pairs}"),
        Column("Base model", "{gate}", WORDS),
    ),
    Bar("difference", "low", "high", 1, signed=True),
)
FACTORIAL = View(
    (
        Column("Effect", "{effect}", HEAD),
        Column("Of", "{factors}", HEAD),
        Column("Change", "{change}", HEAD),
        Column("Task", "{task}", HEAD),
        DIFFERENCE,
        Column("p|Holm", "{p:.3f}", small="{p_holm:.3f}"),
        Column("Smallest effect, points", "{smallest_effect:p.1f}"),
        Column("n", "{n}"),
        Column("Seeds", "{seeds}"),
        Column("Variants", "{cells}"),
        Column("Base model", "{gate}", WORDS),
    ),
    # Interactions reach from -2 to 2.
    Bar("difference", "low", "high", 2, signed=True),
)
SEEDS = View(
    (
        Column("Encoder", "{encoder}", HEAD),
        Column("LoRA", "{lora}", HEAD),
        Column("OPD", "{opd}", HEAD),
        Column("Task", "{task}", HEAD),
        Column("Accuracy %|95 %", "{accuracy:p.2f}", MEASURED, "{low:p.2f} to {high:p.2f}"),
        Column("± over seeds, points|± by answers alone", "{deviation:p.2f}", MEASURED, "{expected:p.2f}"),
        Column("± by answers at the most", "{most:p.2f}"),
        Column("Seeds ±", "{sd_seeds:p.2f}"),
        Column("Objects ±", "{sd_objects:p.2f}"),
        Column("Questions ±", "{sd_questions:p.2f}"),
        Column("Answers ±", "{sd_answers:p.2f}"),
        Column("Seeds", "{seeds}"),
        Column("n", "{n}"),
        Column("Base model", "{gate}", WORDS),
        Column("Note", "{note}", WORDS),
    ),
    Bar("accuracy", "low", "high", 1),
    # Beside every accuracy.
    hidden=("by_seed",),
)
DESCRIBING = View(
    (
        Column("Task", "{task}", HEAD),
        Column("Error %, needed", "{error_needed:p.2f}", MEASURED),
        Column("Error %, all", "{error_all:p.2f}", MEASURED),
        DIFFERENCE,
        Column("Tokens, needed", "{tokens_needed:.0f}"),
        Column("Tokens, all", "{tokens_all:.0f}"),
        Column("n", "{n}"),
        Column("Base model", "{gate}", WORDS),
    ),
    Bar("difference", "low", "high", 1, signed=True),
)
REASONING = View(
    (
        Column("Encoder", "{encoder}", HEAD),
        Column("LoRA", "{lora}", HEAD),
        Column("OPD", "{opd}", HEAD),
        Column("Task", "{task}", HEAD),
        Column("Described right %|95 %", "{described:p.2f}", MEASURED, "{described_low:p.2f} to {described_high:p.2f}"),
        Column("Left out %", "{missing:p.2f}"),
        Column("n", "{n}"),
        Column(
            "Right after that %|95 %", "{concluded:p.2f}", MEASURED, "{concluded_low:p.2f} to {concluded_high:p.2f}"
        ),
        Column("n of that", "{concluded_n}"),
        Column("Right otherwise %|95 %", "{otherwise:p.2f}", MEASURED, "{otherwise_low:p.2f} to {otherwise_high:p.2f}"),
        Column("n otherwise", "{otherwise_n}"),
        Column("All right %", "{accuracy:p.2f}"),
        Column("Chance %", "{chance:p.2f}"),
        Column("Base model", "{gate}", WORDS),
    ),
    Bar("described", "described_low", "described_high", 1),
)
TOUCH = View(
    (
        Column("Touch", "{touch}", HEAD),
        Column("Task", "{task}", HEAD),
        Column("Accuracy %|95 % over objects", "{accuracy:p.2f}", MEASURED, "{low:p.2f} to {high:p.2f}"),
        Column("Chance %", "{chance:p.2f}"),
        Column("Answers unchanged %", "{unchanged:p.2f}"),
        Column(
            "Real minus this, points|95 %",
            "{difference:p+.2f}",
            MEASURED,
            "{difference_low:p.2f} to {difference_high:p.2f}",
        ),
        Column("p", "{p:.3f}"),
        Column("n", "{n}"),
        Column("Base model", "{gate}", WORDS),
    ),
    Bar("accuracy", "low", "high", 1, chance="chance"),
)
LANGUAGE = {
    "ablation": ABLATION,
    "describing": DESCRIBING,
    "directions": DIRECTIONS,
    "effects": EFFECTS,
    "factorial": FACTORIAL,
    "reasoning": REASONING,
    "seeds": SEEDS,
    "touch": TOUCH,
}
