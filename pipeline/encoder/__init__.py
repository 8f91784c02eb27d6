"""The tactile encoder: backbones, CLIP's visual prompts (clip.py), property heads, their training.

In: data/frames and data/splits. Out: data/pretrained (stage `pretrain`), data/encoder (`finetune_encoder`),
data/embeddings (`embed`).
"""
