"""Speed against error: one table over all that was measured, with a recommended setting for each question.

Importing this is quick, for benchmarks draw by `pareto` and measure the memory of processes that import them;
`octopi page` runs `gather`.
"""
