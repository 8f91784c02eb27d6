"""What all rooms stand on: records (the rows of every table), atomic files, errors, seeds, devices and work on many files.

`stage()` is what each script in stages/ runs in: it reads params.yaml, seeds, reports to MLflow and ends with one line.
"""
