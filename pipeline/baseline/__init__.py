"""What classical features and tree ensembles tell of an object: the mark that a neural encoder has to beat."""
