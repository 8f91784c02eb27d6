"""Speed against error, measured: `python -m benchmarks SECTION` writes reports/speed_error.csv and its figures.

A section answers a few questions (which frames, which number format); a question has several settings, a row each.
Costs are ratios to one setting of the question, measured in the same run on the same work in turns; they cannot be
compared from question to question. Counts depend on no machine. Which setting to choose the table does not say: those
on the Pareto front are what is worth choosing from, for the models, objects and machine that they were measured on.
Intervals are about which objects were measured, which all settings have in common: they overlap even where one setting
is clearly worse on the same videos.
"""
