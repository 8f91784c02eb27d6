"""Reports: tables, figures, README (stage `report`) and one page over all of them (`octopi page`).

In: data/graded.parquet and what stages measured. Out: reports/NAME, whose scores.csv every table is a selection of.
"""
