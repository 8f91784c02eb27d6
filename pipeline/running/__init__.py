"""What goes on around a computation: errors in one line, progress, processes, a stage.

Nothing here changes a result, so that no stage of dvc.yaml depends on it.
"""
