"""What fewer bits in the frozen weights change: logits, answers and speed, against float32."""

from __future__ import annotations

import torch

from pipeline.benchmarks.language_bed import FRAMES, OPD, Bed, LanguageRow, differing, make_row, take_turns
from pipeline.language.conversations import ConversationCollator
from pipeline.language.generate import Asking, answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.runtime import DtypeName

FORMATS: tuple[DtypeName, ...] = ("float32", "bfloat16")
BATCH = 16
REPEATS = 3
UNIT = "samples a second"


def format_rows(bed: Bed, limit: int) -> list[LanguageRow]:
    """A row a format: samples a second, share of answers that differ, largest difference of logits.

    Logits are those of the answers' tokens, the reference answers read.
    """
    models = {name: in_format(bed.model, name) for name in FORMATS}
    logits = {name: answer_logits(bed, model) for name, model in models.items()}

    def ask(name: DtypeName) -> list[str]:
        asking = Asking("", FRAMES, limit, BATCH)
        return [p.outputs[0] for p in answer(models[name], bed.store, bed.asked, OPD, asking)]

    said = {name: ask(name) for name in FORMATS}
    cases = {case_of(name): (lambda name=name: ask(name)) for name in FORMATS}
    count, exact = len(bed.asked), logits["float32"]
    rates = take_turns(cases, dict.fromkeys(cases, count), REPEATS)
    return [
        make_row(
            case_of(name),
            UNIT,
            rates,
            case_of("float32"),
            samples=count,
            **differing(said[name], said["float32"], bed.asked),
            logit_error=float((logits[name] - exact).abs().max() / exact.abs().max()),
        )
        for name in FORMATS
    ]


def case_of(name: DtypeName) -> str:
    """The name of a format's row."""
    return f"answering, weights in {name}, {BATCH} at a time"


def in_format(model: OctopiForCausalLM, name: DtypeName) -> OctopiForCausalLM:
    """The same model with its base in another format; connector float32."""
    base = model.octopi_config
    other = OctopiForCausalLM.from_base(base.base_model, base.tactile_dim, dtype=name)
    other.connector.load_state_dict(model.connector.state_dict())
    return other.to(model.connector.delimiters.device).eval()


@torch.inference_mode()
def answer_logits(bed: Bed, model: OctopiForCausalLM) -> torch.Tensor:
    """Logits where an answer's token is foretold: float32, tokens x vocabulary."""
    data, collate = bed.conversations(bed.asked), ConversationCollator(0)
    found = []
    for index in range(len(data)):
        batch = {k: v.to(bed.device) for k, v in collate([data[index]]).items()}
        labels = batch.pop("labels")
        logits = model(**batch).logits
        assert logits is not None
        found.append(logits[:, :-1][labels[:, 1:] >= 0].float())
    return torch.cat(found)
