"""What trainings of encoder and language model share: the Trainer, what is trained, samples, embeddings, cards."""
