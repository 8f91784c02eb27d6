"""Align the projection to the language model."""

import shutil

from pipeline.core.io import read_table, write_json, write_table
from pipeline.core.layout import HISTORY_FILE, split_file, trained_dir
from pipeline.core.records import Encoder, Lora, Measurement, Opd, Variant
from pipeline.language.start import OBJECTS_FILE, objects_met
from pipeline.running.stage import matrix_key, stage
from pipeline.tracking.live import live
from pipeline.videos.records import Assignment

if __name__ == "__main__":
    encoder, opd, seed = matrix_key(encoder=Encoder, opd=Opd, seed=None)
    out = trained_dir(Variant(encoder, Lora.WITHOUT, opd, seed))
    with stage("align", out.name, launched=True, of_variants=True) as run:
        from pipeline.language.begin import begin_with_words
        from pipeline.language.octopi import ADAPTER_DIR
        from pipeline.language.training import Job, Material, assemble, fit, write_model_card

        config = run.params.align
        material = Material.load(run.params, encoder, opd, seed)
        assigned = read_table(split_file(seed), Assignment)
        met = objects_met(run.params.language.start, {a.object_id: a.part for a in assigned})
        model, data = assemble(material, config, "align")
        if config.begin_with_words and not run.params.language.start:
            begin_with_words(model, data, material.catalogue, material.seed)
        if config.train_embeddings == "all" and model.words is None:
            model.train_words()
        with live(run) as callbacks:
            job = Job(run.name, material.fingerprint(config), material.seed, callbacks)
            trained = fit(model, data, config, run.params.runtime, job)
        run.finish_training(trained.history)
        model.save_pretrained(out, trained.state)
        if material.adapter:
            # Alignment does not change the adapter, so it is not in `trained.state` and is copied.
            shutil.copytree(material.adapter, out / ADAPTER_DIR, dirs_exist_ok=True)
        write_json(out / OBJECTS_FILE, met)
        write_table(out / HISTORY_FILE, Measurement, trained.history)
        write_model_card(out, material, data, config)
