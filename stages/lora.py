"""Fine-tune the aligned model end to end, the language model through low-rank adapters."""

from pipeline.core.io import write_table
from pipeline.core.layout import HISTORY_FILE, trained_dir
from pipeline.core.records import Encoder, Lora, Measurement, Opd, Variant
from pipeline.running.stage import matrix_key, stage
from pipeline.tracking.live import live

if __name__ == "__main__":
    encoder, opd, seed = matrix_key(encoder=Encoder, opd=Opd, seed=None)
    aligned, out = (trained_dir(Variant(encoder, lora, opd, seed)) for lora in (Lora.WITHOUT, Lora.WITH))
    with stage("lora", out.name, launched=True, of_variants=True) as run:
        from pipeline.language.lora import add_lora
        from pipeline.language.training import Job, Material, assemble, fit, write_model_card

        config = run.params.lora
        material = Material.load(run.params, encoder, opd, seed)
        model, data = assemble(material, config, "lora", aligned)
        add_lora(model, config)
        with live(run) as callbacks:
            # The connector, and the word embeddings where they were trained.
            inputs = sorted(aligned.glob("*.safetensors"))
            job = Job(run.name, material.fingerprint(config, *inputs), material.seed, callbacks)
            trained = fit(model, data, config, run.params.runtime, job)
        run.finish_training(trained.history)
        model.save_pretrained(out, trained.state)
        write_table(out / HISTORY_FILE, Measurement, trained.history)
        write_model_card(out, material, data, config)
