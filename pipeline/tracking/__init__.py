"""MLflow: a run for each stage, curves while it trains, and models and tables at the end (stage `publish`)."""
