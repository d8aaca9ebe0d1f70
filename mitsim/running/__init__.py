"""How the program runs: worker processes, progress, tables and numbers for readers, the version."""
