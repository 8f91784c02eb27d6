"""What trainings of encoder and language model share: the Trainer, what is trained, the order of the data."""
