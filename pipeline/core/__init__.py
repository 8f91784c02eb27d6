"""What all rooms stand on: records (rows of tables), atomic files, errors, seeds, devices, work on many files.

`stage()` is what each script in stages/ runs in: it reads params.yaml, reports to MLflow and ends with one line.
"""
