"""What results depend on and several rooms share: records, paths and keys, atomic files, seeds and number formats.

Errors, processes and what a stage does around its call are in pipeline/running, since they change no result.
"""
