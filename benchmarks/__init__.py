"""Speed against error, measured: `python -m benchmarks SECTION` writes reports/speed_error.csv and its figures.

A section answers a few questions (which frames, which number format); a question has several settings, a row each.
Costs are ratios to one setting of the question, measured by turns in the same run on the same work; they cannot be
compared between questions. Counts do not depend on the machine. The table recommends no setting: those on the Pareto
front are worth choosing from, for the models, objects and machine that they were measured on. Intervals are over
objects, which all settings share: they may overlap although one setting is clearly worse on the same videos.
"""
