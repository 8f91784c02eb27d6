"""Octopi: tactile embeddings, projected into a language model's word embedding space."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self, cast

import torch
from pydantic import Field, ValidationError
from torch import nn
from torch.distributed.fsdp import FSDPModule
from torch.nn import functional as F
from transformers import DynamicCache, PreTrainedModel, PreTrainedTokenizerBase
from transformers.modeling_outputs import CausalLMOutput

from pipeline.config import TrainedEmbeddings
from pipeline.core.io import read_json, save_tensors, write_json
from pipeline.core.records import Record
from pipeline.core.runtime import DtypeName, Quantization, resolve_dtype
from pipeline.language.base import ADAPTER_CONFIG, load_adapter, load_llm, load_tokenizer
from pipeline.language.cache import extendable
from pipeline.language.chat import IGNORE_INDEX, TACTILE_TOKENS
from pipeline.running.errors import UserError, first_problem
from pipeline.training.trainable import load_trainable

CONFIG_FILE, CONNECTOR_FILE, WORDS_FILE = "config.json", "connector.safetensors", "words.safetensors"
ADAPTER_DIR = "adapter"


class OctopiConfig(Record):
    """config.json of a saved model: its base model and its shapes."""

    model_type: str = "octopi"
    architectures: tuple[str, ...] = ("OctopiForCausalLM",)
    base_model: str
    """Folder of the language model, as `language.weights` named it."""
    tactile_dim: int = Field(ge=1)
    """Length of a tactile embedding."""
    hidden_size: int = Field(ge=1)
    """Length of a word embedding."""
    tactile_tokens: tuple[str, ...] = TACTILE_TOKENS
    normalized: bool = False
    """Whether projected embeddings are as long as the language model's words (`language.normalize_touch`)."""
    trained_embeddings: TrainedEmbeddings = "new"
    """Whether words.safetensors holds embeddings of all words, or the language model's own are used."""


class Connector(nn.Module):
    """The paper's projection (two linear layers, GELU between) and the embeddings of the two new tokens.

    Their embeddings are no rows of the language model's matrix: it keeps its shape, and a plain PEFT adapter stays
    loadable on the untouched base.
    """

    def __init__(self, tactile_dim: int, hidden: int) -> None:
        super().__init__()
        self.projection = nn.Sequential(nn.Linear(tactile_dim, hidden), nn.GELU(), nn.Linear(hidden, hidden))
        self.delimiters = nn.Parameter(torch.zeros(2, hidden))


def read_config(folder: Path) -> OctopiConfig:
    """config.json of a folder that `OctopiForCausalLM.save_pretrained` wrote; anything else is a UserError."""
    try:
        return OctopiConfig.model_validate(read_json(folder / CONFIG_FILE))
    except ValidationError as error:
        raise UserError(f"{folder / CONFIG_FILE}: {first_problem(error)}; run `dvc repro`") from None


class OctopiForCausalLM(nn.Module):
    """A causal language model that reads tactile embeddings at the places of `<tact_frame>`.

    It is no `PreTrainedModel`: those write all of their weights, and here the base (13 GB for Vicuna-7b) stays where it
    is. All that Trainer and accelerate ask of a model is that its `forward` gives a loss.

    Args:
        llm: A Llama-like model, frozen.
        tokenizer: Knows the three tactile tokens. Others that the model has no embedding of are a UserError.
        tactile_dim: Length of a tactile embedding.
        base: Folder that the language model came from.
        normalize: As `language.normalize_touch`.
    """

    accepts_loss_kwargs = True  # has Trainer add up an update's weights and give their sum to `forward`

    def __init__(
        self, llm: PreTrainedModel, tokenizer: PreTrainedTokenizerBase, tactile_dim: int, base: str, normalize: bool
    ) -> None:
        super().__init__()
        self.llm = llm
        words = llm.get_input_embeddings()
        # As the layer gives them: Gemma's scales its rows by the root of their length.
        matrix = words(torch.arange(words.num_embeddings, device=words.weight.device)).detach().float()
        self.connector = Connector(tactile_dim, matrix.shape[1])
        # Not named `config`: Trainer takes an attribute of that name for transformers' own and writes into it.
        self.octopi_config = OctopiConfig(
            base_model=base, tactile_dim=tactile_dim, hidden_size=matrix.shape[1], normalized=normalize
        )
        self.word_rms = float(matrix.square().mean().sqrt()) if normalize else None
        self.words: nn.Embedding | None = None
        """The word embeddings where they are trained (`train_words`), in place of the language model's."""
        with torch.no_grad():
            # The mean of all words is a neutral start for a new one.
            self.connector.delimiters.copy_(matrix.mean(0).expand(2, -1))
        ids = tokenizer.convert_tokens_to_ids(list(TACTILE_TOKENS))
        self.start_id, self.frame_id, self.end_id = ids
        self.tokenizer = tokenizer
        beyond = sorted(t for t, i in tokenizer.get_vocab().items() if i >= len(matrix) and t not in TACTILE_TOKENS)
        if beyond:
            raise UserError(
                f"language.weights: the tokenizer in {base} has {beyond[0]}, of which the model has no embedding "
                f"({len(matrix)} rows); resize the model's embeddings or take the token out"
            )

    @classmethod
    def from_base(
        cls,
        base: Path | str,
        tactile_dim: int,
        *,
        dtype: DtypeName = "float32",
        quantization: Quantization = "none",
        normalize: bool = False,
    ) -> Self:
        """A fresh model on the frozen language model in the folder `base`; its connector is drawn from torch's seed."""
        folder = Path(base)
        llm = load_llm(folder, resolve_dtype(dtype), quantization)
        return cls(llm, load_tokenizer(folder), tactile_dim, str(base), normalize)

    @classmethod
    def from_pretrained(
        cls,
        folder: Path | str,
        *,
        base: Path | str | None = None,
        dtype: DtypeName = "float32",
        quantization: Quantization = "none",
    ) -> Self:
        """Load what `save_pretrained` wrote, ready to answer.

        Args:
            base: Folder of the language model; by default the one that config.json names.
            dtype: Number format of the frozen weights; what was trained is float32 whatever it is.
            quantization: `nf4` for linear layers of four bits (bitsandbytes and CUDA).

        Raises:
            UserError: naming the file that is missing, broken, a pickle, or does not fit the language model.
        """
        folder = Path(folder)
        config = read_config(folder)
        model = cls.from_base(
            base or config.base_model,
            config.tactile_dim,
            dtype=dtype,
            quantization=quantization,
            normalize=config.normalized,
        )
        if model.octopi_config.hidden_size != config.hidden_size:
            raise UserError(
                f"{folder / CONFIG_FILE}: made for word embeddings of {config.hidden_size}, but "
                f"{model.octopi_config.base_model} has {model.octopi_config.hidden_size}; name its own language model, "
                f"{config.base_model}, in language.weights"
            )
        load_trainable(model.connector, folder / CONNECTOR_FILE)
        if config.trained_embeddings == "all":
            load_trainable(model.train_words(), folder / WORDS_FILE)
        if (folder / ADAPTER_DIR).is_dir():
            model.llm = load_adapter(model.llm, folder / ADAPTER_DIR)
        for name, value in model.named_parameters():
            if (name.startswith(("connector.", "words.")) or "lora_" in name) and not value.isfinite().all():
                raise UserError(f"{folder}: {name} is not finite; lower the learning rate it was trained at")
        return model.eval()

    def save_pretrained(self, folder: Path | str, state_dict: Mapping[str, torch.Tensor] | None = None) -> None:
        """Write config.json, the connector and, where there are such, word embeddings and an adapter in PEFT's format.

        `state_dict` replaces the model's parameters where they are sharded; an adapter that it lacks is not written.
        """
        folder = Path(folder)
        parts: dict[str, dict[str, torch.Tensor]] = {"connector": {}, "words": {}, "llm": {}}
        for name, value in (self.state_dict() if state_dict is None else state_dict).items():
            part, _, rest = name.partition(".")
            parts[part][rest] = value
        write_json(folder / CONFIG_FILE, self.octopi_config.model_dump(mode="json"))
        save_tensors(folder / CONNECTOR_FILE, parts["connector"])
        if self.words is not None:
            save_tensors(folder / WORDS_FILE, parts["words"])
        if any("lora_" in name for name in parts["llm"]):
            # In the base's own number format, in which it is added; it was trained in float32.
            dtype, adapter = self.llm.get_input_embeddings().weight.dtype, folder / ADAPTER_DIR
            own = {name: value.to(dtype) if "lora_" in name else value for name, value in parts["llm"].items()}
            self.llm.save_pretrained(str(adapter), state_dict=own)
            # PEFT writes a set, whose order differs from process to process, and an empty model card.
            values = read_json(adapter / ADAPTER_CONFIG)
            write_json(adapter / ADAPTER_CONFIG, {**values, "target_modules": sorted(values["target_modules"])})
            (adapter / "README.md").unlink(missing_ok=True)

    def train_words(self) -> nn.Embedding:
        """Have all word embeddings trained: a copy in float32, which begins as the language model's own.

        The base model and its output head stay unchanged. Where head and input embeddings are tied (SmolLM2), this
        unties them: the input embeddings are trained and the head is not, as in Vicuna, whose head is separate.
        """
        words: nn.Embedding = copy.deepcopy(self.llm.get_input_embeddings()).float().requires_grad_(True)
        # The end token pads some models, whose own layer would then leave it out; padding itself has no gradient here.
        words.padding_idx = None
        self.words = words
        self.octopi_config = self.octopi_config.model_copy(update={"trained_embeddings": "all"})
        return words

    def embed_words(self, input_ids: torch.Tensor) -> torch.Tensor:
        """Embeddings of words, trained or not, in the language model's number format: batch x length x hidden.

        `input_ids`, batch x length, has no tactile tokens.
        """
        own = self.llm.get_input_embeddings()
        found = own(input_ids) if self.words is None else self.words(input_ids).to(own.weight.dtype)
        return cast(torch.Tensor, found)

    @property
    def positions(self) -> int | None:
        """Tokens that the language model can read at once, prompt and answer together; None where it does not say."""
        return cast("int | None", getattr(self.llm.config.get_text_config(), "max_position_embeddings", None))

    def embed(self, input_ids: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """Word embeddings with the tactile ones in their places: batch x length x hidden, in the model's number format.

        Args:
            input_ids: batch x length.
            features: batch x (most frames of a row) x tactile_dim; a row's frames come first, in reading order, and
                what lies behind them is padding that is never read.
        """
        tactile = torch.isin(input_ids, input_ids.new_tensor([self.start_id, self.frame_id, self.end_id]))
        # The tactile tokens have no row in the word matrix.
        embeddings = self.embed_words(input_ids.masked_fill(tactile, 0))
        frames = input_ids == self.frame_id
        used = torch.arange(features.shape[1], device=features.device) < frames.sum(1, keepdim=True)
        projected = self.connector.projection(features[used].to(self.connector.delimiters.dtype))
        if self.word_rms is not None:
            projected = self.word_rms * F.rms_norm(projected, projected.shape[-1:])
        embeddings = embeddings.masked_scatter(frames[..., None], projected.to(embeddings.dtype))
        for token, row in ((self.start_id, 0), (self.end_id, 1)):
            delimiter = self.connector.delimiters[row].to(embeddings.dtype)
            embeddings = torch.where((input_ids == token)[..., None], delimiter, embeddings)
        return embeddings

    def forward(
        self,
        input_ids: torch.Tensor,
        features: torch.Tensor,
        labels: torch.Tensor | None = None,
        weights: torch.Tensor | None = None,
        num_items_in_batch: torch.Tensor | int | None = None,
    ) -> CausalLMOutput:
        """Without labels `logits`, batch x length x vocabulary; with labels `loss`, over the answers' tokens alone.

        Args:
            input_ids: batch x length, padded on the right where rows differ: no token sees a later one.
            features: batch x frames x tactile_dim, as `embed` wants them.
            labels: batch x length, each token its own label; `IGNORE_INDEX` is left out.
            weights: batch x length, how much each labelled token counts; by default 1.
            num_items_in_batch: What the weighted sum of cross-entropies is divided by: the sum of the weights of the
                whole update, of which this may be a part; by default that of this batch.
        """
        embeddings = self.embed(input_ids, features)
        if labels is None:
            return CausalLMOutput(logits=self.llm(inputs_embeds=embeddings, use_cache=False).logits)
        call: dict[str, Any] = {"use_cache": False}
        shared = self._shared(input_ids, labels)
        if shared:
            # The common prefix is computed for one row. Its embeddings need a gradient only where words are trained.
            first = embeddings[:1, :shared] if self.words is not None else embeddings[:1, :shared].detach()
            cache = DynamicCache(config=self.llm.config)
            self.llm(inputs_embeds=first, past_key_values=cache, use_cache=True, logits_to_keep=1)
            cache.batch_repeat_interleave(len(embeddings))
            call = {"past_key_values": cache, "use_cache": True}
        # Each column predicts the next token. In long prompts few columns are needed by any row.
        targets = labels[:, shared + 1 :]
        learned = targets != IGNORE_INDEX
        columns = learned.any(0).nonzero().flatten()
        output = self.llm(inputs_embeds=embeddings[:, shared:], **call, logits_to_keep=columns)
        logits = output.logits[learned[:, columns]]
        exact = logits.to(torch.promote_types(logits.dtype, torch.float32))
        each = F.cross_entropy(exact, targets[learned], reduction="none")
        counted = torch.ones_like(each) if weights is None else weights[:, shared + 1 :][learned].to(each.dtype)
        total = counted.sum() if num_items_in_batch is None else torch.as_tensor(num_items_in_batch, device=each.device)
        return CausalLMOutput(loss=each @ counted / torch.where(total > 0, total, 1))

    def _shared(self, input_ids: torch.Tensor, labels: torch.Tensor) -> int:
        """Number of first columns that are equal in all rows, before any frame and any token that predicts a label.

        0 in a sharded model: computing the prefix is an extra forward pass, for which all processes must gather the
        layers; if one had no prefix, the others would wait for it.
        """
        if not extendable(self.llm.config) or (self.training and self.llm.is_gradient_checkpointing):
            return 0
        if any(isinstance(module, FSDPModule) for module in self.modules()):
            return 0
        alike = (input_ids == input_ids[:1]) & (input_ids != self.start_id) & (labels == IGNORE_INDEX)
        # One less: the last of these columns may predict a label.
        return max(0, int(alike.all(0).long().cumprod(0).sum()) - 1)
