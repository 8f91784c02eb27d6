"""The language model: touch projected into its word embeddings, alignment, LoRA, and answers.

In: data/questions and data/embeddings. Out: data/models/without (stage `align`), data/models/with (`lora`),
data/answers (`answer`).
"""
