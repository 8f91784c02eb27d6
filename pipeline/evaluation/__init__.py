"""From answers to figures: grades (stage `grade`), scores, intervals, paired tests, calibration, maps (`report`).

In: data/answers, data/questions and the encoder's predictions. answer_with.py asks other models the same questions.
"""
