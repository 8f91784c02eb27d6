"""What can be trusted in a data set, measured: its files, its labels, and what leaks from one part into another."""
